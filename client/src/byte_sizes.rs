//! Numbers of bytes as flags take them.

/// "200MB", "64MiB", "1.5 GB", "4096".
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    const UNITS: [(&str, f64); 9] = [
        ("KiB", 1024.0),
        ("MiB", 1_048_576.0),
        ("GiB", 1_073_741_824.0),
        ("kB", 1e3),
        ("KB", 1e3),
        ("MB", 1e6),
        ("GB", 1e9),
        ("TB", 1e12),
        ("B", 1.0),
    ];
    let (number, factor) = UNITS.iter().find_map(|(unit, f)| Some((text.strip_suffix(unit)?, *f))).unwrap_or((text, 1.0));
    let bytes = number.trim_end().parse::<f64>().ok().map(|n| n * factor).filter(|b| (0.0..=1e18).contains(b));
    bytes.map(|b| b as u64).ok_or_else(|| "a number of bytes expected, such as 4096, 200MB or 64MiB".to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_have_units() {
        let read = ["4096", "1.5kB", "200MB", "64MiB", "1 GB", "7B"].map(parse_bytes);
        assert_eq!(read, [4096, 1500, 200_000_000, 67_108_864, 1_000_000_000, 7].map(Ok));
        for bad in ["", "MB", "-1", "1e40", "NaN", "12 parsecs"] {
            assert!(parse_bytes(bad).is_err(), "{bad}");
        }
    }
}
