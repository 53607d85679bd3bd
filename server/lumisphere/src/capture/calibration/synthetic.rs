//! Photographs of a checkerboard from a known camera, for tests.

use glam::{DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::grey::Grey;
use super::lens::{Extrinsics, Lens};
use super::{BoardPhotograph, Checkerboard};
use crate::geometry::Distortion;

/// A camera like that of the data pack's checkerboards.
pub(super) fn lens() -> Lens {
    let distortion = Distortion::new([-0.26, 0.08, 0.0018, -0.0003]).unwrap();
    Lens { size_px: [640, 480], focal_px: DVec2::new(536.0, 534.0), center_px: DVec2::new(342.9, 236.0), distortion }
}

/// Looks at `target` from `distance` away: `zenith` off +Z toward `azimuth`, rolled, all in degrees.
pub(super) fn around(target: DVec3, [zenith, azimuth, roll]: [f64; 3], distance: f64) -> Extrinsics {
    let (z, a) = (zenith.to_radians(), azimuth.to_radians());
    let toward = DVec3::new(z.sin() * a.cos(), z.sin() * a.sin(), z.cos());
    let up = if toward.z > 0.999 { DVec3::Y } else { DVec3::Z };
    let x = up.cross(toward).normalize();
    let turn = DMat3::from_rotation_z(roll.to_radians());
    let rotation = turn * DMat3::from_cols(x, toward.cross(x), toward).transpose();
    Extrinsics { rotation, translation: -(rotation * (target + distance * toward)) }
}

/// Twelve photographs from different sides, every corner in view.
pub(super) fn round_trip(board: &Checkerboard) -> Vec<Extrinsics> {
    let middle = (0.5 * board.corner(board.corner_count() - 1)).extend(0.0);
    let width = board.corner(board.corner_count() - 1).length();
    let view = |i: usize| {
        let turn = i as f64;
        let aside = width * DVec3::new(0.12 * (turn * 2.1).cos(), 0.1 * (turn * 1.3).sin(), 0.0);
        around(middle + aside, [10.0 + 3.2 * turn, 77.0 * turn, 31.0 * turn], width * (1.35 + 0.05 * (turn % 5.0)))
    };
    (0..12).map(view).collect()
}

/// Where the corners are seen, with normal noise of `noise_px` along each axis.
pub(super) fn seen(lens: &Lens, board: &Checkerboard, views: &[Extrinsics], noise_px: f64, seed: u64) -> Vec<BoardPhotograph> {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let photograph = |(i, view): (usize, &Extrinsics)| {
        let corner = |&p: &DVec2| lens.project(view.rotation * p.extend(0.0) + view.translation).unwrap() + noise_px * normal(&mut random);
        BoardPhotograph { file: format!("view{i}"), size_px: lens.size_px, corners_px: board.corners().iter().map(corner).collect() }
    };
    views.iter().enumerate().map(photograph).collect()
}

// Two normal numbers by Box and Muller.
pub(super) fn normal(random: &mut Pcg64Mcg) -> DVec2 {
    let (u, v): (f64, f64) = (random.random(), random.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * DVec2::from_angle(std::f64::consts::TAU * v)
}

/// A photograph of the board on a grey wall: 16 samples a pixel, lit less to one side, with noise.
pub(super) fn photograph(lens: &Lens, board: &Checkerboard, view: &Extrinsics, noise: f64, seed: u64) -> Grey {
    let [width, height] = lens.size_px.map(|n| n as usize);
    let mut values = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let center = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
            let Some(pinhole) = lens.pinhole_of(center) else {
                values.push(0.0);
                continue;
            };
            // Within a pixel the lens is as good as linear.
            let slope = lens.distortion.jacobian(pinhole).inverse();
            let sample = |i: usize| {
                // Sixteen columns and sixteen rows (Hammersley): a grid of four by four would place a level edge to a quarter pixel only.
                let offset = (DVec2::new(i as f64, f64::from((i as u8).reverse_bits() >> 4)) + 0.5) / 16.0 - 0.5;
                brightness(board, view, pinhole + slope * (offset / lens.focal_px))
            };
            let light = 0.55 + 0.45 * column as f64 / width as f64;
            values.push((light * (0..16).map(sample).sum::<f64>() / 16.0) as f32);
        }
    }
    let mut grey = Grey { width, height, values };
    add_noise(&mut grey, noise, seed);
    grey
}

/// Normal noise on every pixel.
pub(super) fn add_noise(grey: &mut Grey, noise: f64, seed: u64) {
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    for value in &mut grey.values {
        *value += (noise * normal(&mut random).x) as f32;
    }
}

fn brightness(board: &Checkerboard, view: &Extrinsics, pinhole: DVec2) -> f64 {
    const WALL: f64 = 0.45;
    let back = view.rotation.transpose();
    let (origin, direction) = (view.position(), back * DVec3::new(pinhole.x, -pinhole.y, -1.0));
    let along = -origin.z / direction.z;
    let p = origin + along * direction;
    // Corner 0 stands a square in from the outer edge; outside of it the first square is black.
    let cell = DVec2::new(p.x, p.y) / board.corner(1).x + 1.0;
    let (column, row) = (cell.x.floor(), cell.y.floor());
    let on_board = |margin: f64| {
        let (columns, rows) = (board.columns() as f64 + 1.0, board.rows() as f64 + 1.0);
        cell.x > -margin && cell.y > -margin && cell.x < columns + margin && cell.y < rows + margin
    };
    match (along > 0.0 && on_board(0.5), on_board(0.0)) {
        (false, _) => WALL,
        // A white rim of half a square.
        (true, false) => 0.9,
        (true, true) if (column + row) % 2.0 == 0.0 => 0.05,
        (true, true) => 0.9,
    }
}
