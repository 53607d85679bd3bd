//! A height field over the unit square as an OBJ file, which any program reads.

use std::fmt::Write;

use glam::{Vec2, Vec3};

/// The mesh of `steps` × `steps` quadrilaterals over x, z ∈ [−½, ½], facing +Y; u along +X, v along −Z. `height` gets places in [0, 1]², x
/// along +X and y along +Z. Normals are those of the field itself, by differences over one step.
pub(super) fn obj(steps: u32, height: impl Fn(Vec2) -> f32) -> Vec<u8> {
    let step = 1.0 / steps as f32;
    let mut text = String::new();
    for row in 0..=steps {
        for column in 0..=steps {
            let at = Vec2::new(column as f32, row as f32) * step;
            let (x, z) = (at.x - 0.5, at.y - 0.5);
            let across = |by: Vec2| (height(at + by) - height(at - by)) / step;
            let normal = Vec3::new(-across(0.5 * step * Vec2::X), 1.0, -across(0.5 * step * Vec2::Y)).normalize();
            // Six digits are a thousandth of a step; fewer differ between mathematical libraries.
            let _infallible = write!(
                text,
                "v {x:.6} {:.6} {z:.6}\nvt {:.6} {:.6}\nvn {:.5} {:.5} {:.5}\n",
                height(at),
                at.x,
                1.0 - at.y,
                normal.x,
                normal.y,
                normal.z
            );
        }
    }
    let vertex = |row: u32, column: u32| row * (steps + 1) + column + 1;
    for row in 0..steps {
        for column in 0..steps {
            let corners = [vertex(row, column), vertex(row + 1, column), vertex(row + 1, column + 1), vertex(row, column + 1)];
            let [a, b, c, d] = corners.map(|i| format!("{i}/{i}/{i}"));
            let _infallible = writeln!(text, "f {a} {b} {c} {d}");
        }
    }
    text.into_bytes()
}
