//! RTI's `.lp`: photographs by a fixed camera under known light directions.
//!
//! The first line is the number of photographs, every further one `file x y z`: x right, y up, z toward the camera, all at the surface.
//! By reciprocity a fit over these light directions is that over view directions under a light at the camera.

use std::collections::HashSet;

use glam::{DVec3, Vec3};

use super::known_cameras::{InFile, KnownCamerasError, new_name};

/// A photograph and the light it was taken under.
#[derive(Debug, Clone, PartialEq)]
pub struct LitPhotograph {
    /// Name as written; it may hold spaces.
    pub file: String,
    /// Unit vector from the surface to the light, z > 0.
    pub toward_light: Vec3,
}

/// Reads an `.lp` file; `file` is its name in errors. Refused: a count that is not that of the lines, numbers that are not finite, the
/// zero vector, a light that is not in front of the surface, a photograph named twice.
pub fn read(file: &str, bytes: &[u8]) -> Result<Vec<LitPhotograph>, KnownCamerasError> {
    let file = InFile(file);
    let mut lines = file.text(bytes)?.lines().enumerate().map(|(i, line)| (i + 1, line.trim())).filter(|(_, line)| !line.is_empty());
    let (_, head) = lines.next().ok_or_else(|| file.missing("an empty file", "number of photographs"))?;
    let announced: usize = head.parse().map_err(|_| file.wrong("line 1", format!("{head:?}"), "the number of photographs"))?;
    file.few_enough(announced)?;
    let mut names = HashSet::new();
    let mut photographs = Vec::new();
    for (line, text) in lines {
        let place = format!("line {line}");
        let photograph = photograph(file, &place, text)?;
        new_name(file, &mut names, &place, &photograph.file)?;
        photographs.push(photograph);
    }
    if photographs.len() != announced {
        return Err(KnownCamerasError::Count { announced, found: photographs.len(), file: file.0.into() });
    }
    Ok(photographs)
}

fn photograph(file: InFile, place: &str, text: &str) -> Result<LitPhotograph, KnownCamerasError> {
    // From the end, because the name may hold spaces.
    let mut words = text.rsplitn(4, char::is_whitespace);
    let (Some(z), Some(y), Some(x), Some(name)) = (words.next(), words.next(), words.next(), words.next()) else {
        return Err(file.wrong(place, format!("{text:?}"), "file x y z"));
    };
    let number = |axis: &str, word: &str| file.number(format!("{place}: {axis}"), word);
    let light = DVec3::new(number("x", x)?, number("y", y)?, number("z", z)?);
    let toward_light = light.try_normalize().ok_or_else(|| file.wrong(place, format!("{x} {y} {z}"), "a direction, not zero"))?;
    if !(toward_light.z > 0.0) {
        return Err(file.wrong(format!("{place}: z"), z, "a light in front of the surface (z above 0)"));
    }
    Ok(LitPhotograph { file: name.trim().into(), toward_light: toward_light.as_vec3() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testdata::shared;

    fn wrong(text: &str) -> String {
        read("d.lp", text.as_bytes()).unwrap_err().to_string()
    }

    #[test]
    fn a_line_is_a_name_that_may_hold_spaces_and_a_direction_of_any_length() {
        let read = read("d.lp", b"2\r\nmy icon 1.jpg 0 0 2\r\nb.jpg 3 0 4\r\n\r\n").unwrap();
        assert_eq!(read[0], LitPhotograph { file: "my icon 1.jpg".into(), toward_light: Vec3::Z });
        assert!((read[1].toward_light - Vec3::new(0.6, 0.0, 0.8)).length() < 1e-7);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line_and_value() {
        assert_eq!(wrong("2\na.jpg 0 0 1\n"), "2 photographs announced, 1 found: d.lp");
        assert_eq!(wrong("1\na.jpg 0 0 1\nb.jpg 0 0 1\n"), "1 photographs announced, 2 found: d.lp");
        assert_eq!(wrong("1\na.jpg 0 NaN 1\n"), r#"line 2: y is "NaN", a finite number expected: d.lp"#);
        assert_eq!(wrong("1\na.jpg 0 0 0\n"), "line 2 is 0 0 0, a direction, not zero expected: d.lp");
        assert_eq!(wrong("1\na.jpg 0 1 0\n"), "line 2: z is 0, a light in front of the surface (z above 0) expected: d.lp");
        assert_eq!(wrong("2\na.jpg 0 0 1\na.jpg 0 1 1\n"), r#"line 3 names "a.jpg" again: d.lp"#);
        assert_eq!(wrong("1\n0 0 1\n"), r#"line 2 is "0 0 1", file x y z expected: d.lp"#);
        assert_eq!(wrong("a.jpg 0 0 1\n"), r#"line 1 is "a.jpg 0 0 1", the number of photographs expected: d.lp"#);
        assert_eq!(wrong(""), "an empty file has no number of photographs: d.lp");
        assert_eq!(wrong("99999999999\n"), "99999999999 photographs, 1 to 65536 expected: d.lp");
        assert!(wrong("-1\n").contains("the number of photographs expected"));
    }

    #[test]
    fn the_data_packs_icon_has_72_lights_in_front_of_it() {
        let Some(path) = shared("rti/san_michele/dirs.lp") else { return };
        let lights = read("dirs.lp", &std::fs::read(path).unwrap()).unwrap();
        assert_eq!((lights.len(), lights[71].file.as_str()), (72, "image72.jpg"));
        assert!((lights[0].toward_light - Vec3::new(0.205159, -0.237021, 0.949595)).length() < 1e-6);
    }
}
