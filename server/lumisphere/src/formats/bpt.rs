//! Bicubic Bézier patches as text, the layout in which the tea set ships (`data/geometry`).
//!
//! `#` lines are comments; the first other line counts patches and control points; then 16 indices (from 1) a patch; then a point
//! a line. The last line ends like every other, so that a file cut off inside its last number is seen to be cut off.

use glam::Vec3;

use super::FormatError;
use crate::geometry::BezierPatch;

/// Which axis of the file points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UpAxis {
    /// As ours.
    Y,
    /// (x, y, z) of the file is our (x, z, −y).
    Z,
}

/// No file of patches needs more; a count beyond is a broken file, not a reason to ask for memory.
const MAX_PATCHES: usize = 100_000;

/// All patches of a file, +Y up, orientation (∂u × ∂v) as the file has it.
pub fn read(bytes: &[u8], up: UpAxis) -> Result<Vec<BezierPatch>, FormatError> {
    let text = std::str::from_utf8(bytes).map_err(|e| FormatError::File(format!("not a patch file: {e}")))?;
    if !text.ends_with('\n') {
        return Err(FormatError::File("patch file is cut off: its last line has no end".into()));
    }
    let mut lines = text.lines().enumerate().map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.is_empty() && !l.starts_with('#'));
    let [patch_count, point_count] = numbers::<usize, 2>(lines.next(), "the number of patches and of points")?;
    if !(1..=MAX_PATCHES).contains(&patch_count) || !(1..=16 * MAX_PATCHES).contains(&point_count) {
        return Err(FormatError::File(format!("{patch_count} patches with {point_count} points, 1 to {MAX_PATCHES} patches expected")));
    }
    let indices = (0..patch_count).map(|_| numbers::<usize, 16>(lines.next(), "16 point numbers")).collect::<Result<Vec<_>, _>>()?;
    let mut points = Vec::new();
    for _ in 0..point_count {
        let p = Vec3::from(numbers::<f32, 3>(lines.next(), "a point x y z")?);
        if !p.is_finite() {
            return Err(FormatError::File(format!("point {} is not finite", points.len() + 1)));
        }
        points.push(match up {
            UpAxis::Y => p,
            UpAxis::Z => Vec3::new(p.x, p.z, -p.y),
        });
    }
    if let Some((line, rest)) = lines.next() {
        return Err(FormatError::Line { line, message: format!("{rest:?} after the last point, the end expected") });
    }
    indices.iter().enumerate().map(|(i, patch)| assemble(i, patch, &points)).collect()
}

fn assemble(patch: usize, indices: &[usize; 16], points: &[Vec3]) -> Result<BezierPatch, FormatError> {
    let mut corners = [Vec3::ZERO; 16];
    for (corner, index) in corners.iter_mut().zip(indices) {
        *corner = *index
            .checked_sub(1)
            .and_then(|i| points.get(i))
            .ok_or_else(|| FormatError::File(format!("patch {} names point {index}, 1 to {} expected", patch + 1, points.len())))?;
    }
    Ok(BezierPatch { points: corners })
}

fn numbers<T: std::str::FromStr + Copy + Default, const N: usize>(line: Option<(usize, &str)>, what: &str) -> Result<[T; N], FormatError> {
    let (line, text) = line.ok_or_else(|| FormatError::File(format!("patch file is cut off: {what} expected")))?;
    let wrong = || FormatError::Line { line, message: format!("{:?}, {what} expected", text.chars().take(60).collect::<String>()) };
    let mut values = [T::default(); N];
    let mut words = text.split_whitespace();
    for value in &mut values {
        *value = words.next().and_then(|w| w.parse().ok()).ok_or_else(wrong)?;
    }
    if words.next().is_some() { Err(wrong()) } else { Ok(values) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_patch() -> String {
        let indices: Vec<String> = (1..=16).map(|i| i.to_string()).collect();
        let points: String = (0..16).map(|i| format!("{} {} 0.5\n", i / 4, i % 4)).collect();
        format!("# a square\n1 16\n{}\n{points}", indices.join(" "))
    }

    #[test]
    fn z_up_becomes_y_up_by_a_rotation() {
        let patch = read(one_patch().as_bytes(), UpAxis::Z).unwrap()[0];
        assert_eq!(patch.points[6], Vec3::new(1.0, 0.5, -2.0));
        // ∂u × ∂v was +Z in the file, so it is +Y here.
        assert!(patch.point(0.5, 0.5).normal.dot(Vec3::Y) > 0.999);
        assert_eq!(read(one_patch().as_bytes(), UpAxis::Y).unwrap()[0].points[6], Vec3::new(1.0, 2.0, 0.5));
    }

    #[test]
    fn a_file_cut_off_anywhere_is_an_error() {
        let text = one_patch();
        for length in 0..text.len() {
            assert!(read(&text.as_bytes()[..length], UpAxis::Z).is_err(), "{length} bytes");
        }
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let wrong = |from: &str, to: &str| read(one_patch().replacen(from, to, 1).as_bytes(), UpAxis::Z).unwrap_err().to_string();
        assert_eq!(wrong("1 16", "1 x"), r#"line 2: "1 x", the number of patches and of points expected"#);
        assert_eq!(wrong("1 2 3", "1 2 17"), "patch 1 names point 17, 1 to 16 expected");
        assert_eq!(wrong("1 2 3", "0 2 3"), "patch 1 names point 0, 1 to 16 expected");
        assert_eq!(wrong("0 0 0.5", "0 NaN 0.5"), "point 1 is not finite");
        assert!(wrong("1 16", "99999999999 16").contains("1 to 100000 patches expected"));
        assert!(read(format!("{}1 2 3\n", one_patch()).as_bytes(), UpAxis::Z).is_err());
    }
}
