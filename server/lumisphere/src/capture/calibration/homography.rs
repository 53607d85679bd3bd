//! The projective map from a plane to its image, from four or more points (Hartley 1997, "In defense of the eight-point algorithm", for
//! the scaling).

use glam::{DMat3, DVec2, DVec3};

use crate::fitting::cholesky::Cholesky;

// In scaled coordinates, where both sets of points have a spread of √2 and the depth is 1 at their middle. A plane seen 0.01° from its edge
// has a determinant of 10⁻⁴; rounding leaves 10⁻¹³ of a collapsed one.
const LEAST_DETERMINANT: f64 = 1e-9;
const LEAST_DEPTH: f64 = 1e-6;

/// The homography `image ~ H (x, y, 1)` with least algebraic error in scaled coordinates; exact for four points. None when the points
/// determine none: fewer than four, three of four on a line, coinciding, not finite, or not all on one side of the horizon (no camera sees
/// the plane like that). `H · (x, y, 1)` has a positive third component at every point.
pub fn homography(plane: &[DVec2], image: &[DVec2]) -> Option<DMat3> {
    if plane.len() != image.len() || plane.len() < 4 {
        return None;
    }
    let (to_plane_unit, to_image_unit) = (to_unit(plane)?, to_unit(image)?);
    let plane = moved(to_plane_unit, plane);
    let unit = solved(&plane, &moved(to_image_unit, image))?;
    let depth = |p: &DVec2| (unit * p.extend(1.0)).z;
    let proper = unit.determinant().abs() > LEAST_DETERMINANT && plane.iter().all(|p| depth(p) > LEAST_DEPTH);
    proper.then(|| to_image_unit.inverse() * unit * to_plane_unit)
}

/// `H` applied to a point of the plane.
pub fn mapped(homography: &DMat3, point: DVec2) -> DVec2 {
    let p = *homography * point.extend(1.0);
    DVec2::new(p.x, p.y) / p.z
}

// Eight unknowns (the ninth is 1 at the centre of the points, which is in front of the camera) from the normal equations.
fn solved(plane: &[DVec2], image: &[DVec2]) -> Option<DMat3> {
    const UNKNOWNS: usize = 8;
    let (mut matrix, mut right) = ([0.0; UNKNOWNS * UNKNOWNS], [0.0; UNKNOWNS]);
    for (p, q) in plane.iter().zip(image) {
        for (row, value) in [
            ([p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y], q.x), //
            ([0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y], q.y),
        ] {
            for (i, a) in row.iter().enumerate() {
                right[i] += a * value;
                for (j, b) in row.iter().enumerate() {
                    matrix[i * UNKNOWNS + j] += a * b;
                }
            }
        }
    }
    Cholesky::new(&matrix, UNKNOWNS)?.solve(&mut right);
    let [a, b, c, d, e, f, g, h] = right;
    Some(DMat3::from_cols(DVec3::new(a, d, g), DVec3::new(b, e, h), DVec3::new(c, f, 1.0)))
}

// Moves the points' mean to the origin and their root mean square distance to √2.
fn to_unit(points: &[DVec2]) -> Option<DMat3> {
    let count = points.len() as f64;
    let mean = points.iter().sum::<DVec2>() / count;
    let spread = (points.iter().map(|p| (p - mean).length_squared()).sum::<f64>() / count).sqrt();
    if !(spread > 0.0 && spread.is_finite()) {
        return None;
    }
    let scale = std::f64::consts::SQRT_2 / spread;
    Some(DMat3::from_cols(DVec3::X * scale, DVec3::Y * scale, (-scale * mean).extend(1.0)))
}

fn moved(by: DMat3, points: &[DVec2]) -> Vec<DVec2> {
    points.iter().map(|&p| mapped(&by, p)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testdata::shared;

    const SQUARE: [DVec2; 4] = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];

    #[test]
    fn four_points_are_met_exactly_and_more_on_average() {
        let truth = DMat3::from_cols_array(&[300.0, 20.0, 0.2, -40.0, 250.0, -0.1, 100.0, 90.0, 1.0]);
        let found = homography(&SQUARE, &SQUARE.map(|p| mapped(&truth, p))).unwrap();
        let p = DVec2::new(0.3, 0.8);
        // Condition of the scaled normal equations about 10³: 13 digits of some hundred pixels.
        assert!((mapped(&found, p) - mapped(&truth, p)).length() < 1e-9);
        let grid: Vec<DVec2> = (0..54).map(|i| DVec2::new((i % 9) as f64, (i / 9) as f64) / 8.0).collect();
        let image: Vec<DVec2> = grid.iter().enumerate().map(|(i, &p)| mapped(&truth, p) + if i % 2 == 0 { 0.5 } else { -0.5 }).collect();
        let found = homography(&grid, &image).unwrap();
        // 54 alternating errors of 0.7 px, eight unknowns: what remains at a point is about 0.7 · √(8 / 108).
        assert!((mapped(&found, p) - mapped(&truth, p)).length() < 0.3);
    }

    #[test]
    fn points_that_determine_none_give_none() {
        let line = [0.0, 1.0, 2.0, 3.0].map(|x| DVec2::new(x, 2.0 * x));
        assert_eq!(homography(&SQUARE, &line), None);
        assert_eq!(homography(&line, &SQUARE), None);
        assert_eq!(homography(&SQUARE, &[SQUARE[0], SQUARE[1], SQUARE[1], SQUARE[3]]), None);
        assert_eq!(homography(&SQUARE, &[DVec2::ONE; 4]), None);
        assert_eq!(homography(&SQUARE[..3], &SQUARE[..3]), None);
        assert_eq!(homography(&SQUARE, &[DVec2::NAN, DVec2::X, DVec2::ONE, DVec2::Y]), None);
        // Two neighbours exchanged: the sides cross, so points lie beyond the horizon.
        assert_eq!(homography(&SQUARE, &[DVec2::ZERO, DVec2::X, DVec2::Y, DVec2::new(2.0, 1.5)]), None);
    }

    #[test]
    fn the_data_packs_wall_is_recovered_from_four_of_its_points() {
        let Some(path) = shared("planar/graf/H1to3p.xml") else { return };
        let text = std::fs::read_to_string(path).unwrap();
        let data = text.split("<data>").nth(1).unwrap().split("</data>").next().unwrap();
        let numbers: Vec<f64> = data.split_whitespace().map(|w| w.parse().unwrap()).collect();
        let published = DMat3::from_cols_slice(&numbers).transpose();
        let corners = SQUARE.map(|p| p * DVec2::new(800.0, 640.0));
        let found = homography(&corners, &corners.map(|p| mapped(&published, p))).unwrap();
        let p = DVec2::new(333.0, 222.0);
        assert!((mapped(&found, p) - mapped(&published, p)).length() < 1e-8);
    }
}
