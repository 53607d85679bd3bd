//! What a generated scene can be asked for, and in which range. Called by whoever generates one; the server reads the options from a
//! request by their names ([`BuiltinOptions::set`]).

use glam::Vec3;

use super::super::error::SceneError;

/// Sizes and seed of a generated scene, and what its own generator asks for besides.
#[derive(Debug, Clone, PartialEq)]
pub struct BuiltinOptions {
    /// Of all noise: textures, clouds, foliage, creases.
    pub seed: u32,
    /// Edge of the gazebo's cloth's texture, which other textures follow; the patchwork's have half and a quarter. 16 to 8192.
    pub texture_px: u32,
    /// Width of the generated sky (twice its height). 16 to 8192.
    pub sky_px: u32,
    /// Steps along each edge of the teapot's patches; cups and spoon have half. 2 to 256.
    pub patch_steps: u32,
    /// Of `glossy_plane`.
    pub plane: PlaneOptions,
    /// Of `patchwork`.
    pub patchwork: PatchworkOptions,
    /// Lights the scene in place of the generated sky: file name (with extension) and bytes, latitude–longitude EXR or .hdr.
    pub environment: Option<(String, Vec<u8>)>,
}

/// Of the scene `glossy_plane`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneOptions {
    /// Phong's exponent m. 2 to 10000.
    pub shininess: f32,
    /// What stands at (1.5, 2, −1.5).
    pub lamp: PlaneLamp,
    /// A second point light at (d, 2, −d), given d; None: there is one only. −10 to 10.
    pub second_light: Option<f32>,
    /// Intensity of the second light over that of the first. 0 to 10.
    pub second_strength: f32,
}

/// The first light of `glossy_plane`; all of them send the same to the middle of the plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlaneLamp {
    /// A point.
    Point,
    /// Nine points, 3 × 3 of them 0.15 apart at the same height.
    NinePoints,
    /// A disc of radius 0.2 that faces the middle of the plane.
    Disc,
}

/// Of the scene `patchwork`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchworkOptions {
    /// Steps of the relief along each edge of the patchwork. 16 to 512.
    pub relief_steps: u32,
    /// Middle of the lamp, which faces the patchwork. At least 1 above it, each coordinate −20 to 20.
    pub lamp: Vec3,
}

impl PlaneLamp {
    const ALL: [Self; 3] = [Self::Point, Self::NinePoints, Self::Disc];

    /// As in `BuiltinOptions::set`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Point => "point",
            Self::NinePoints => "nine_points",
            Self::Disc => "disc",
        }
    }
}

impl PlaneOptions {
    // A band that every model of the source can still follow ("13.1 Increasing Shininess": m ≈ 15), and a second light slightly weaker
    // than the first ("11.3.2").
    const USUAL: Self = Self { shininess: 15.0, lamp: PlaneLamp::Point, second_light: None, second_strength: 0.8 };
}

impl PatchworkOptions {
    const USUAL: Self = Self { relief_steps: 256, lamp: Vec3::new(1.6, 3.2, -2.0) };
}

impl BuiltinOptions {
    /// As shown in the documentation: 2048² cloth, 1024 × 512 sky, 16 steps an edge, relief of 256 steps.
    pub fn full() -> Self {
        Self {
            seed: 1,
            texture_px: 2048,
            sky_px: 1024,
            patch_steps: 16,
            plane: PlaneOptions::USUAL,
            patchwork: PatchworkOptions::USUAL,
            environment: None,
        }
    }

    /// The same scenes, coarse: for tests.
    pub fn small() -> Self {
        let patchwork = PatchworkOptions { relief_steps: 48, ..PatchworkOptions::USUAL };
        Self { texture_px: 256, sky_px: 256, patch_steps: 6, patchwork, ..Self::full() }
    }

    /// Sets one option by its name. Ranges are `checked` when all are set. Errors on unknown names and on what is no such value.
    ///
    /// `seed`, `texture_px`, `sky_px`, `patch_steps`, `relief_steps`: whole numbers; `shininess`, `second_light`, `second_strength`:
    /// numbers; `plane_lamp`: "point", "nine_points" or "disc"; `lamp`: "x,y,z".
    pub fn set(&mut self, name: &str, value: &str) -> Result<(), SceneError> {
        const NAMES: &str =
            "seed, texture_px, sky_px, patch_steps, relief_steps, shininess, plane_lamp, second_light, second_strength or lamp";
        let wrong = |expected: &str| refused(name, value, expected);
        let whole = || value.parse::<u32>().map_err(|_| wrong("a whole number"));
        let number = || value.parse::<f32>().map_err(|_| wrong("a number"));
        match name {
            "seed" => self.seed = whole()?,
            "texture_px" => self.texture_px = whole()?,
            "sky_px" => self.sky_px = whole()?,
            "patch_steps" => self.patch_steps = whole()?,
            "relief_steps" => self.patchwork.relief_steps = whole()?,
            "shininess" => self.plane.shininess = number()?,
            "plane_lamp" => {
                let lamp = PlaneLamp::ALL.into_iter().find(|lamp| lamp.name() == value);
                self.plane.lamp = lamp.ok_or_else(|| wrong("point, nine_points or disc"))?;
            }
            "second_light" => self.plane.second_light = Some(number()?),
            "second_strength" => self.plane.second_strength = number()?,
            "lamp" => {
                let numbers: Option<Vec<f32>> = value.split(',').map(|part| part.trim().parse().ok()).collect();
                let place: Option<[f32; 3]> = numbers.and_then(|n| n.try_into().ok());
                self.patchwork.lamp = place.ok_or_else(|| wrong("three numbers x,y,z"))?.into();
            }
            _ => return Err(refused("parameter", name, NAMES)),
        }
        Ok(())
    }

    /// The options, if each is in its range.
    pub fn checked(self) -> Result<Self, SceneError> {
        let (plane, patchwork) = (&self.plane, &self.patchwork);
        let lamp = patchwork.lamp;
        let ranges = [
            ("texture_px", self.texture_px as f32, 16.0, 8192.0),
            ("sky_px", self.sky_px as f32, 16.0, 8192.0),
            ("patch_steps", self.patch_steps as f32, 2.0, 256.0),
            ("shininess", plane.shininess, 2.0, 10_000.0),
            ("second_light", plane.second_light.unwrap_or(0.0), -10.0, 10.0),
            ("second_strength", plane.second_strength, 0.0, 10.0),
            ("relief_steps", patchwork.relief_steps as f32, 16.0, 512.0),
            ("x of lamp", lamp.x, -20.0, 20.0),
            ("y of lamp", lamp.y, 1.0, 20.0),
            ("z of lamp", lamp.z, -20.0, 20.0),
        ];
        // NaN is in no range.
        match ranges.into_iter().find(|(_, value, low, high)| !(*low..=*high).contains(value)) {
            None => Ok(self),
            Some((place, value, low, high)) => Err(refused(place, &value.to_string(), &format!("{low} to {high}"))),
        }
    }
}

fn refused(place: &str, value: &str, expected: &str) -> SceneError {
    // A name or a number: longer ones come from mistakes.
    let value = value.chars().take(60).collect();
    SceneError::Value { file: "options of the built-in scene".into(), place: place.into(), value, expected: expected.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(name: &str, value: &str) -> Result<BuiltinOptions, String> {
        let mut options = BuiltinOptions::full();
        options.set(name, value).and_then(|()| options.checked()).map_err(|e| e.to_string())
    }

    #[test]
    fn every_option_is_set_by_its_name() {
        let full = BuiltinOptions::full();
        for (name, value) in [
            ("seed", "2"),
            ("texture_px", "64"),
            ("sky_px", "64"),
            ("patch_steps", "5"),
            ("relief_steps", "64"),
            ("shininess", "40.5"),
            ("plane_lamp", "nine_points"),
            ("second_light", "-0.45"),
            ("second_strength", "0.5"),
            ("lamp", "1, 2.5,-3"),
        ] {
            assert_ne!(set(name, value).unwrap(), full, "{name}");
        }
        assert_eq!(set("lamp", "1, 2.5,-3").unwrap().patchwork.lamp, Vec3::new(1.0, 2.5, -3.0));
        assert_eq!(set("plane_lamp", "disc").unwrap().plane.lamp, PlaneLamp::Disc);
    }

    #[test]
    fn what_is_no_such_value_is_named_with_what_was_expected() {
        for (name, value, complaint) in [
            ("colour", "1", "parameter is colour, seed, texture_px"),
            ("seed", "-1", "seed is -1, a whole number expected"),
            ("shininess", "NaN", "shininess is NaN, 2 to 10000 expected"),
            ("shininess", "1.5", "shininess is 1.5, 2 to 10000 expected"),
            ("plane_lamp", "sun", "plane_lamp is sun, point, nine_points or disc expected"),
            ("lamp", "1,2", "lamp is 1,2, three numbers x,y,z expected"),
            ("lamp", "0,0,0", "y of lamp is 0, 1 to 20 expected"),
            ("relief_steps", "4096", "relief_steps is 4096, 16 to 512 expected"),
        ] {
            let message = set(name, value).unwrap_err();
            assert!(message.starts_with(complaint), "{message}");
        }
    }
}
