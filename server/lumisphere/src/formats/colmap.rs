//! COLMAP's text model: `cameras.txt` (intrinsics and lens) and `images.txt` (poses).
//!
//! COLMAP's pixels have their centres at half integers, as ours do; its cameras look along +Z with y down and store the rigid transform
//! from the world to the camera, a quaternion (w x y z) and a translation. The world's axes are COLMAP's, which are arbitrary.

use std::collections::{HashMap, HashSet};
use std::ops::Range;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::known_cameras::{InFile, KnownCamerasError, Lens, new_name};
use crate::geometry::PhotographCamera;

/// The cameras of the photographs, in the order of `images.txt`. Both names are for errors. Refused: a camera model other than
/// SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL and OPENCV, a wrong number of parameters, numbers that are not finite, a quaternion
/// that is no rotation, a photograph without its line of image points, ids and names given twice or never.
pub fn read(cameras: (&str, &[u8]), images: (&str, &[u8])) -> Result<Vec<PhotographCamera>, KnownCamerasError> {
    let lenses = read_cameras(InFile(cameras.0), cameras.1)?;
    let file = InFile(images.0);
    // Of a photograph's two lines the second may be empty, so only what stands where a first line should is passed over.
    let mut lines = file.text(images.1)?.lines().enumerate();
    let mut names = HashSet::new();
    let mut photographs = Vec::new();
    while let Some((i, line)) = lines.next() {
        if is_remark(line) {
            continue;
        }
        let place = format!("line {}", i + 1);
        let photograph = photograph(file, &place, line, &lenses)?;
        new_name(file, &mut names, &place, &photograph.file)?;
        let points = lines.next().ok_or_else(|| file.missing(&place, "line of image points after it (which may be empty)"))?;
        check_points(file, points)?;
        photographs.push(photograph);
    }
    file.few_enough(photographs.len())?;
    Ok(photographs)
}

fn is_remark(line: &str) -> bool {
    let line = line.trim();
    line.is_empty() || line.starts_with('#')
}

fn read_cameras(file: InFile, bytes: &[u8]) -> Result<HashMap<u32, Lens>, KnownCamerasError> {
    let mut lenses = HashMap::new();
    for (i, line) in file.text(bytes)?.lines().enumerate().filter(|(_, line)| !is_remark(line)) {
        let place = format!("line {}", i + 1);
        let words: Vec<&str> = line.split_whitespace().collect();
        let &[id, model, width, height, ref parameters @ ..] = words.as_slice() else {
            return Err(file.wrong(place, format!("{line:?}"), "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"));
        };
        let lens = lens(file, &place, model, [width, height], parameters)?;
        if lenses.insert(id_of(file, &format!("{place}: CAMERA_ID"), id)?, lens).is_some() {
            return Err(file.duplicate(place, format!("camera {id}")));
        }
    }
    Ok(lenses)
}

fn id_of(file: InFile, place: &str, word: &str) -> Result<u32, KnownCamerasError> {
    word.parse().map_err(|_| file.wrong(place, format!("{word:?}"), "a whole number"))
}

// Parameters by COLMAP's models.h: focal length(s), principal point, radial, tangential.
fn lens(file: InFile, place: &str, model: &str, size: [&str; 2], parameters: &[&str]) -> Result<Lens, KnownCamerasError> {
    let name = |what: &str| format!("{place}: {what}");
    let numbers = parameters.iter().map(|word| file.number(name("PARAMS"), word)).collect::<Result<Vec<_>, _>>()?;
    let (focal_px, center_px, coefficients) = match (model, numbers.as_slice()) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], [0.0; 4]),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], [0.0; 4]),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], [k, 0.0, 0.0, 0.0]),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], [k1, k2, 0.0, 0.0]),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => ([fx, fy], [cx, cy], [k1, k2, p1, p2]),
        ("SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV", other) => {
            let expected = match model {
                "SIMPLE_PINHOLE" => "3 (f cx cy)",
                "PINHOLE" => "4 (fx fy cx cy)",
                "SIMPLE_RADIAL" => "4 (f cx cy k)",
                "RADIAL" => "5 (f cx cy k1 k2)",
                _ => "8 (fx fy cx cy k1 k2 p1 p2)",
            };
            return Err(file.wrong(name("PARAMS"), format!("{} numbers", other.len()), format!("{expected} of a {model} camera")));
        }
        _ => {
            return Err(file.wrong(name("MODEL"), format!("{model:?}"), "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV"));
        }
    };
    let side = |what: &str, word: &str| file.side_px(name(what), file.number(name(what), word)?);
    let size_px = [side("WIDTH", size[0])?, side("HEIGHT", size[1])?];
    let lens = Lens { size_px, focal_px: DVec2::from(focal_px), center_px: DVec2::from(center_px), coefficients };
    if !(lens.focal_px.min_element() > 0.0) {
        return Err(file.wrong(name("PARAMS"), format!("focal length {}", lens.focal_px.min_element()), "a number above 0"));
    }
    Ok(lens)
}

fn photograph(file: InFile, place: &str, line: &str, lenses: &HashMap<u32, Lens>) -> Result<PhotographCamera, KnownCamerasError> {
    const NUMBERS: usize = 9;
    let expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME";
    let (words, name) = split_words(line, NUMBERS).ok_or_else(|| file.wrong(place, format!("{line:?}"), expected))?;
    let number =
        |at: Range<usize>, what: &str| words[at].iter().map(|w| file.number(format!("{place}: {what}"), w)).collect::<Result<Vec<_>, _>>();
    id_of(file, &format!("{place}: IMAGE_ID"), words[0])?;
    let id = id_of(file, &format!("{place}: CAMERA_ID"), words[8])?;
    let lens = lenses.get(&id).ok_or_else(|| file.wrong(format!("{place}: CAMERA_ID"), id, "a camera of cameras.txt"))?;
    let rotation = rotation(file, place, &number(1..5, "QW QX QY QZ")?)?;
    let translation = DVec3::from_slice(&number(5..8, "TX TY TZ")?);
    file.photograph(place, name, *lens, file.pose_from_opencv(place, rotation, translation)?)
}

fn rotation(file: InFile, place: &str, wxyz: &[f64]) -> Result<DMat3, KnownCamerasError> {
    // Wide enough for three written digits.
    const UNIT_TOLERANCE: f64 = 1e-2;
    let quaternion = DQuat::from_xyzw(wxyz[1], wxyz[2], wxyz[3], wxyz[0]);
    if !((quaternion.length() - 1.0).abs() <= UNIT_TOLERANCE) {
        let expected = format!("length 1 within {UNIT_TOLERANCE}");
        return Err(file.wrong(format!("{place}: QW QX QY QZ"), format!("{wxyz:?}"), expected));
    }
    Ok(DMat3::from_quat(quaternion.normalize()))
}

// The first `count` words and what follows them, which may hold spaces. None when there is less.
fn split_words(line: &str, count: usize) -> Option<(Vec<&str>, &str)> {
    let mut rest = line.trim();
    let mut words = Vec::with_capacity(count);
    for _ in 0..count {
        let (word, after) = rest.split_once(char::is_whitespace)?;
        words.push(word);
        rest = after.trim_start();
    }
    (!rest.is_empty()).then_some((words, rest))
}

// Image points are not kept, but a file that left their lines out would lose every second photograph.
fn check_points(file: InFile, (i, line): (usize, &str)) -> Result<(), KnownCamerasError> {
    let are_points = line.split_whitespace().all(|w| w.parse::<f64>().is_ok()) && line.split_whitespace().count() % 3 == 0;
    let expected = "the image points X Y POINT3D_ID of the photograph above (the line may be empty)";
    if are_points { Ok(()) } else { Err(file.wrong(format!("line {}", i + 1), format!("{line:?}"), expected)) }
}

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3};

    use super::*;
    use crate::testdata::shared;

    const CAMERAS: &str = "# remark\n1 OPENCV 640 480 500 510 320 240 -0.2 0.05 0.001 -0.002\n\n7 SIMPLE_RADIAL 100 80 90 50 40 0.1\n";
    const IMAGES: &str = "# remark\n1 1 0 0 0 0 0 5 1 a b.jpg\n10 20 -1 30 40 5\n2 0.7071 0 0.7071 0 0 0 5 7 b.jpg\n\n";

    fn wrong(from: &str, to: &str) -> String {
        let changed = |text: &str| text.replacen(from, to, 1).into_bytes();
        assert!(CAMERAS.contains(from) || IMAGES.contains(from), "{from:?} is in neither");
        read(("cameras.txt", &changed(CAMERAS)), ("images.txt", &changed(IMAGES))).unwrap_err().to_string()
    }

    #[test]
    fn a_camera_looks_along_its_own_plus_z_with_y_down() {
        let read = read(("", CAMERAS.as_bytes()), ("", IMAGES.as_bytes())).unwrap();
        assert_eq!((read[0].file.as_str(), read[1].file.as_str()), ("a b.jpg", "b.jpg"));
        // t = (0, 0, 5) without rotation: the camera stands at −5 and sees world +Y downward in the image.
        assert!((read[0].camera.pose().position() - Vec3::new(0.0, 0.0, -5.0)).length() < 1e-6);
        assert!(read[0].project(Vec3::new(0.0, 1.0, 0.0)).unwrap().y > 330.0);
        assert_eq!(read[0].distortion.coefficients(), [-0.2, 0.05, 0.001, -0.002]);
        assert_eq!(read[1].distortion.coefficients(), [0.1, 0.0, 0.0, 0.0]);
        assert_eq!(read[1].camera.intrinsics().focal_px, Vec2::splat(90.0));
    }

    #[test]
    fn what_is_wrong_is_named_with_file_line_and_value() {
        let model = r#"line 2: MODEL is "OPENCV_FISHEYE", SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV expected: cameras.txt"#;
        assert_eq!(wrong("OPENCV", "OPENCV_FISHEYE"), model);
        let parameters = "line 4: PARAMS is 3 numbers, 4 (f cx cy k) of a SIMPLE_RADIAL camera expected: cameras.txt";
        assert_eq!(wrong("90 50 40 0.1", "90 50 40"), parameters);
        assert_eq!(wrong("-0.2", "NaN"), r#"line 2: PARAMS is "NaN", a finite number expected: cameras.txt"#);
        assert_eq!(wrong("90 50", "0 50"), "line 4: PARAMS is focal length 0, a number above 0 expected: cameras.txt");
        assert_eq!(wrong("640", "0"), "line 2: WIDTH is 0, a whole number from 1 to 131072 expected: cameras.txt");
        assert_eq!(wrong("7 SIMPLE", "1 SIMPLE"), "line 4 names camera 1 again: cameras.txt");
        assert_eq!(wrong("5 7 b", "5 8 b"), "line 4: CAMERA_ID is 8, a camera of cameras.txt expected: images.txt");
        assert_eq!(wrong("7 b.jpg", "7 a b.jpg"), r#"line 4 names "a b.jpg" again: images.txt"#);
        assert!(wrong("0.7071 0 0.7071", "0.7 0 0.6").starts_with("line 4: QW QX QY QZ is [0.7, 0.0, 0.6, 0.0], length 1 within 0.01"));
        assert!(wrong("1 1 0 0 0 0 0 5 1", "1 inf 0 0 0 0 0 5 1").starts_with(r#"line 2: QW QX QY QZ is "inf", a finite number"#));
        assert!(wrong("10 20 -1 30 40 5\n", "").contains("the image points X Y POINT3D_ID of the photograph above"));
        assert!(wrong("b.jpg\n\n", "b.jpg").contains("has no line of image points after it"));
        assert!(wrong(" a b.jpg", "").contains("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME expected"));
        let none = read(("", CAMERAS.as_bytes()), ("i", b"# none\n")).unwrap_err().to_string();
        assert_eq!(none, "0 photographs, 1 to 65536 expected: i");
    }

    #[test]
    fn cut_off_anywhere_it_never_panics() {
        for length in 0..IMAGES.len() {
            let _ = read(("", CAMERAS.as_bytes()), ("", &IMAGES.as_bytes()[..length]));
        }
        for length in 0..CAMERAS.len() {
            let _ = read(("", &CAMERAS.as_bytes()[..length]), ("", IMAGES.as_bytes()));
        }
    }

    #[test]
    fn the_temples_cameras_image_what_their_projection_matrices_say() {
        let Some(path) = shared("multiview/temple/templeSR_par.txt") else { return };
        let text = std::fs::read_to_string(path).unwrap();
        // Name, K, R, t in one line each; P = K [R | t], image positions with pixel centres at whole numbers.
        let numbers = |line: &str| line.split_whitespace().skip(1).map(|w| w.parse().unwrap()).collect::<Vec<f64>>();
        let (mut cameras, mut images) = (String::new(), String::new());
        for (i, line) in text.lines().skip(1).enumerate() {
            let n = numbers(line);
            cameras += &format!("{i} PINHOLE 640 480 {} {} {} {}\n", n[0], n[4], n[2] + 0.5, n[5] + 0.5);
            let q = DQuat::from_mat3(&DMat3::from_cols_slice(&n[9..18]).transpose());
            images += &format!("{i} {} {} {} {} {} {} {} {i} {i}.png\n\n", q.w, q.x, q.y, q.z, n[18], n[19], n[20]);
        }
        let photographs = read(("", cameras.as_bytes()), ("", images.as_bytes())).unwrap();
        assert_eq!(photographs.len(), 16);
        for (photograph, line) in photographs.iter().zip(text.lines().skip(1)) {
            let n = numbers(line);
            let (k, r) = (DMat3::from_cols_slice(&n[..9]).transpose(), DMat3::from_cols_slice(&n[9..18]).transpose());
            // Two corners of the box around the temple, from the data's README.
            for point in [DVec3::new(-0.073568, 0.021728, -0.012445), DVec3::new(0.028855, 0.181892, 0.062736)] {
                let p = k * (r * point + DVec3::new(n[18], n[19], n[20]));
                let expected = DVec2::new(p.x / p.z, p.y / p.z) + 0.5;
                let found = photograph.project(point.as_vec3()).unwrap().as_dvec2();
                // A focal length of 1520 px over f32 coordinates: 1520 · 1e-7 · a few roundings.
                assert!((found - expected).length() < 2e-3, "{}: {found} instead of {expected}", photograph.file);
                assert!((0.0..640.0).contains(&found.x) && (0.0..480.0).contains(&found.y));
            }
        }
    }
}
