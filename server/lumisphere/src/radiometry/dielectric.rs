//! Clear bodies: what a ray does at a smooth surface between air and a clear medium, and on its way through a body of it.
//!
//! The tracer's truth and the renderer both take it from here. Fresnel's equations for unpolarised light, Snell's law in vector form (Heckbert
//! 1989). What is followed is one reflection outside, and one way through: in, so many total reflections, out. What is partly reflected inside
//! is lost, as is what never leaves; the radiance's factor n² cancels between in and out.

use glam::Vec3;
use serde::Serialize;

/// Total reflections inside that are followed.
pub const MOST_INTERNAL: u32 = 4;
/// Index of refraction, the largest: germanium has 4.
pub const MOST_INDEX: f32 = 4.0;

/// A clear body.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Dielectric {
    index: f32,
    body: Body,
}

/// What is inside the surface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Body {
    /// The medium.
    Solid,
    /// Air: the surface is a sheet, thin enough to let light through without shifting it; reflections within the sheet are summed.
    Thin,
}

impl Body {
    /// On the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Solid => "solid",
            Self::Thin => "thin",
        }
    }
}

/// A place on the body's surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodyPoint {
    /// Any space, the same for all.
    pub position: Vec3,
    /// Unit, outward.
    pub normal: Vec3,
}

/// How a ray leaves the body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Passage<P> {
    /// Where; None where the surface has no other side, and the ray leaves it where it came.
    pub exit: Option<P>,
    /// Unit.
    pub direction: Vec3,
    /// Share of the radiance beyond that passes both surfaces, in [0, 1].
    pub transmittance: f32,
}

impl Dielectric {
    /// `index` in [1, [`MOST_INDEX`]], relative to the air outside; None otherwise.
    pub fn new(index: f32, body: Body) -> Option<Self> {
        (1.0..=MOST_INDEX).contains(&index).then_some(Self { index, body })
    }

    /// `solid-1.5`, in reports.
    pub fn name(self) -> String {
        format!("{}-{}", self.body.name(), self.index)
    }

    /// Relative to the air outside.
    pub fn index(&self) -> f32 {
        self.index
    }

    /// What is inside.
    pub fn body(&self) -> Body {
        self.body
    }

    /// Share that the outside of the surface reflects of light at this cosine from its normal.
    pub fn reflectance(&self, cosine: f32) -> f32 {
        let of_surface = fresnel_reflectance(cosine, self.index);
        match self.body {
            Body::Solid => of_surface,
            // R + T²R + T²R³ + … with T = 1 − R.
            Body::Thin => 2.0 * of_surface / (1.0 + of_surface),
        }
    }

    /// The way of a ray with unit direction `d` from the outside point `entry` through the body. `next(from, direction)` finds the surface's
    /// next point inside. None where it is still inside after [`MOST_INTERNAL`] total reflections.
    pub fn passage<P: AsRef<BodyPoint>>(
        &self,
        entry: &BodyPoint,
        d: Vec3,
        mut next: impl FnMut(&BodyPoint, Vec3) -> Option<P>,
    ) -> Option<Passage<P>> {
        let entering = 1.0 - self.reflectance(-entry.normal.dot(d));
        if self.body == Body::Thin {
            let Some(exit) = next(entry, d) else { return Some(Passage { exit: None, direction: d, transmittance: entering }) };
            let leaving = 1.0 - self.reflectance(exit.as_ref().normal.dot(d).abs());
            return Some(Passage { exit: Some(exit), direction: d, transmittance: entering * leaving });
        }
        let mut direction = refracted(d, entry.normal, 1.0 / self.index)?;
        let mut from = *entry;
        for _ in 0..=MOST_INTERNAL {
            let Some(exit) = next(&from, direction) else { return Some(Passage { exit: None, direction, transmittance: entering }) };
            from = *exit.as_ref();
            let inward = -from.normal;
            if let Some(out) = refracted(direction, inward, self.index) {
                // Both ways of light have one reflectance: that of the angle outside.
                let leaving = 1.0 - self.reflectance(from.normal.dot(out));
                return Some(Passage { exit: Some(exit), direction: out, transmittance: entering * leaving });
            }
            direction = (direction - 2.0 * direction.dot(inward) * inward).normalize();
        }
        None
    }
}

/// The normal on the side to which a ray leaves: the shading one, unless it points back, where the geometric one does not.
pub fn outward(shading: Vec3, geometric: Vec3, direction: Vec3) -> Vec3 {
    if shading.dot(direction) > 0.0 {
        return shading;
    }
    if geometric.dot(direction) > 0.0 { geometric } else { -geometric }
}

impl AsRef<Self> for BodyPoint {
    fn as_ref(&self) -> &Self {
        self
    }
}

/// Reflectance for unpolarised light of a surface between air and a medium of this index, seen from the air.
pub fn fresnel_reflectance(cosine: f32, index: f32) -> f32 {
    let cosine = cosine.clamp(0.0, 1.0);
    let inside = (1.0 - (1.0 - cosine * cosine) / (index * index)).max(0.0).sqrt();
    let (crossing, along) = (index * inside, index * cosine);
    if !(cosine + crossing > 0.0 && along + inside > 0.0) {
        return 1.0;
    }
    let perpendicular = (cosine - crossing) / (cosine + crossing);
    let parallel = (along - inside) / (along + inside);
    0.5 * (perpendicular * perpendicular + parallel * parallel)
}

/// The direction of unit `d` behind a surface with unit normal `n` on the side it comes from; `ratio`: index before over index behind. None
/// where it is totally reflected.
pub fn refracted(d: Vec3, n: Vec3, ratio: f32) -> Option<Vec3> {
    let cosine = (-n.dot(d)).clamp(0.0, 1.0);
    let squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine);
    (squared > 0.0).then(|| (ratio * d + (ratio * cosine - squared.sqrt()) * n).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn glass(body: Body) -> Dielectric {
        Dielectric::new(1.5, body).unwrap()
    }

    /// The next point of the unit sphere about the origin.
    fn on_the_sphere(from: &BodyPoint, direction: Vec3) -> Option<BodyPoint> {
        let position = from.position - 2.0 * from.position.dot(direction) * direction;
        Some(BodyPoint { position, normal: position })
    }

    #[test]
    fn glass_reflects_four_per_cent_along_the_normal_and_all_at_the_horizon() {
        assert!((fresnel_reflectance(1.0, 1.5) - 0.04).abs() < 1e-6 && (fresnel_reflectance(0.0, 1.5) - 1.0).abs() < 1e-6);
        // Brewster's angle: only the perpendicular half is left, ((n² − 1)/(n² + 1))²/2.
        let brewster = 1.5f32.atan().cos();
        assert!((fresnel_reflectance(brewster, 1.5) - 0.5 * (1.25f32 / 3.25).powi(2)).abs() < 1e-6);
        assert!((glass(Body::Thin).reflectance(1.0) - 0.08 / 1.04).abs() < 1e-6);
        assert!(fresnel_reflectance(0.3, 1.0) < 1e-12);
    }

    #[test]
    fn sines_are_as_the_indices_and_back_again() {
        let (n, d) = (Vec3::Y, Vec3::new(0.6, -0.8, 0.0));
        let inside = refracted(d, n, 1.0 / 1.5).unwrap();
        assert!((inside - Vec3::new(0.4, -(1.0f32 - 0.16).sqrt(), 0.0)).length() < 1e-6, "{inside}");
        assert!((refracted(inside, n, 1.5).unwrap() - d).length() < 1e-6);
        // Beyond asin(1/1.5) nothing leaves glass.
        assert!(refracted(Vec3::new(0.68, -(1.0f32 - 0.68 * 0.68).sqrt(), 0.0), n, 1.5).is_none());
    }

    /// A ray that enters a ball leaves it at the angle at which it came, deviated by twice the difference of the angles.
    #[test]
    fn a_ball_deviates_by_twice_the_angle_at_its_surface() {
        for sine in [0.0f32, 0.3, 0.7, 0.95] {
            let entry = BodyPoint {
                position: Vec3::new(sine, 0.0, (1.0 - sine * sine).sqrt()),
                normal: Vec3::new(sine, 0.0, (1.0 - sine * sine).sqrt()),
            };
            let passage = glass(Body::Solid).passage(&entry, Vec3::NEG_Z, on_the_sphere).unwrap();
            let turned = 2.0 * (sine.asin() - (sine / 1.5).asin());
            let expected = Vec3::new(-turned.sin(), 0.0, -turned.cos());
            assert!((passage.direction - expected).length() < 1e-5, "{sine}: {} where {expected} is exact", passage.direction);
            let once = 1.0 - fresnel_reflectance((1.0 - sine * sine).sqrt(), 1.5);
            assert!((passage.transmittance - once * once).abs() < 1e-4, "{}", passage.transmittance);
            let straight = glass(Body::Thin).passage(&entry, Vec3::NEG_Z, on_the_sphere).unwrap();
            assert_eq!(straight.direction, Vec3::NEG_Z);
        }
    }

    #[test]
    fn what_never_leaves_is_lost_and_a_sheet_has_no_other_side() {
        let entry = BodyPoint { position: Vec3::Z, normal: Vec3::Z };
        // A body whose next surface is always met too flatly.
        let flat = |from: &BodyPoint, direction: Vec3| {
            let across = direction.any_orthonormal_vector();
            Some(BodyPoint { position: from.position, normal: (0.2 * direction + across).normalize() })
        };
        assert_eq!(glass(Body::Solid).passage(&entry, Vec3::NEG_Z, flat), None);
        let open = glass(Body::Thin).passage(&entry, Vec3::NEG_Z, |_, _| None::<BodyPoint>).unwrap();
        assert!(open.exit.is_none() && (open.transmittance - (1.0 - 0.08 / 1.04)).abs() < 1e-6);
    }

    #[test]
    fn indices_from_one_to_four_are_bodies() {
        let is_body = |index| Dielectric::new(index, Body::Solid).is_some();
        assert!(is_body(1.0) && is_body(4.0) && !is_body(0.99) && !is_body(4.01) && !is_body(f32::NAN));
    }
}
