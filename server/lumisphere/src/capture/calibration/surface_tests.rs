//! From a surface's four corners to poses: cameras that are known, noise, both planar poses, and corners that are wrong.

use glam::{DMat3, DVec2, DVec3};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;

use super::lens::Extrinsics;
use super::refine::greatest_rms_px;
use super::synthetic::{around, normal};
use super::*;
use crate::geometry::{Distortion, PhotographCamera};

fn lens() -> Lens {
    let distortion = Distortion::new([-0.2, 0.05, 0.001, -0.002]).unwrap();
    Lens { size_px: [1600, 1200], focal_px: DVec2::new(1800.0, 1790.0), center_px: DVec2::new(810.0, 590.0), distortion }
}

fn surface() -> Surface {
    Surface::new(0.297, 0.21).unwrap()
}

fn camera(zenith: f64, azimuth: f64, distance: f64) -> Extrinsics {
    around(DVec3::new(0.1485, 0.105, 0.0), [zenith, azimuth, 17.0], distance)
}

// Corners with an error of about `noise_px` along each axis, the same at every call.
fn marked(lens: &Lens, camera: &Extrinsics, noise_px: f64, near: Option<DVec3>) -> MarkedPhotograph {
    let error = [DVec2::new(0.3, -0.8), DVec2::new(-0.9, -0.4), DVec2::new(0.7, 0.6), DVec2::new(-0.2, 0.9)];
    let corner = |(p, e): (DVec2, DVec2)| lens.projection(camera, p.extend(0.0)).unwrap().at_px + noise_px * e;
    MarkedPhotograph {
        file: "a.jpg".into(),
        size_px: lens.size_px,
        corners_px: surface().corners().into_iter().zip(error).map(corner).collect(),
        near,
    }
}

fn one(photograph: MarkedPhotograph, noise_px: f64) -> PosedPhotograph {
    let posed = pose_photographs(&lens(), &surface(), &[photograph], LensUse::Fixed, Some(noise_px)).unwrap();
    posed.photographs.into_iter().next().unwrap()
}

fn apart(posed: &PhotographCamera, truth: &Extrinsics) -> f64 {
    posed.camera.pose().position().as_dvec3().distance(truth.position())
}

fn tele() -> Lens {
    Lens { focal_px: DVec2::splat(60_000.0), distortion: Distortion::NONE, ..lens() }
}

fn far(noise_px: f64, near: Option<DVec3>) -> MarkedPhotograph {
    marked(&tele(), &camera(40.0, 70.0, 30.0), noise_px, near)
}

#[test]
fn exact_corners_give_the_pose_from_every_side() {
    for zenith in [0.0, 10.0, 30.0, 60.0, 80.0] {
        for azimuth in [0.0, 100.0, 200.0, 300.0] {
            let truth = camera(zenith, azimuth, 0.7);
            let posed = one(marked(&lens(), &truth, 0.0, None), 0.1);
            // The pose is handed on in f32.
            assert!(apart(&posed.camera, &truth) < 1e-5, "{zenith}/{azimuth}");
            assert_ne!(posed.decided_by, DecidedBy::Nothing, "{zenith}/{azimuth}");
            assert!(posed.rms_px < 1e-9, "{zenith}/{azimuth}");
        }
    }
}

#[test]
fn noise_of_half_a_pixel_moves_the_camera_by_a_hundredth_of_its_distance() {
    for noise_px in [0.1, 0.2, 0.3, 0.5] {
        for zenith in [20.0, 40.0, 60.0, 75.0] {
            let truth = camera(zenith, 40.0, 0.7);
            let posed = one(marked(&lens(), &truth, noise_px, None), noise_px);
            // The sheet is 760 px wide: its size is known to noise / 760, its tilt, which is only seen in the perspective of one side
            // against the other (a fifth of the size), to some 5 · noise / 760 of a radian, and that moves a camera on its circle.
            let limit = 0.7 * (8.0 * noise_px / 760.0);
            assert!(apart(&posed.camera, &truth) < limit, "{zenith}°, {noise_px} px: {}", apart(&posed.camera, &truth));
            assert_ne!(posed.decided_by, DecidedBy::Nothing, "{zenith}°, {noise_px} px");
        }
    }
}

#[test]
fn where_the_corners_do_not_decide_a_hint_does_and_without_one_nothing() {
    let posed = |near| {
        let all = pose_photographs(&tele(), &surface(), &[far(0.5, near)], LensUse::Fixed, Some(0.5));
        all.unwrap().photographs.remove(0)
    };
    let place = |camera: &PhotographCamera| camera.camera.pose().position().as_dvec3();
    let unhinted = posed(None);
    assert_eq!(unhinted.decided_by, DecidedBy::Nothing);
    let both = [place(&unhinted.camera), place(&unhinted.rival.unwrap().0)];
    // The other tilt leans to the opposite side of the line of sight: some 80° away.
    assert!(both[0].distance(both[1]) > 20.0);
    for (hint, other) in [(both[0], both[1]), (both[1], both[0])] {
        let hinted = posed(Some(hint + DVec3::splat(3.0)));
        assert_eq!(hinted.decided_by, DecidedBy::Hint);
        assert!(place(&hinted.camera).distance(hint) < place(&hinted.camera).distance(other));
    }
    assert_eq!(posed(Some(DVec3::NAN)).decided_by, DecidedBy::Nothing);
}

#[test]
fn what_the_other_photographs_leave_tells_how_much_the_corners_can_decide() {
    let alone = pose_photographs(&tele(), &surface(), &[far(0.0, None)], LensUse::Fixed, None).unwrap();
    assert_eq!(alone.photographs[0].decided_by, DecidedBy::Corners);
    let noisy = marked(&tele(), &camera(20.0, 10.0, 30.0), 3.0, None);
    let among = pose_photographs(&tele(), &surface(), &[far(0.0, None), noisy.clone(), noisy], LensUse::Fixed, None).unwrap();
    assert_eq!(among.photographs[0].decided_by, DecidedBy::Nothing);
}

#[test]
fn many_photographs_correct_the_focal_length_and_principal_point_given() {
    let views = (0..12).map(|i| camera(25.0 + 4.0 * f64::from(i), 77.0 * f64::from(i), 0.7));
    let photographs: Vec<_> = views.map(|view| marked(&lens(), &view, 0.05, None)).collect();
    let given = Lens { focal_px: 1.02 * lens().focal_px, center_px: lens().center_px + 8.0, ..lens() };
    let posed = pose_photographs(&given, &surface(), &photographs, LensUse::RefinePinhole, None).unwrap();
    for i in 0..4 {
        let off = posed.lens.parameters()[i] - lens().parameters()[i];
        // Four reported deviations, as for normal noise; they are below 3 px here.
        assert!(off.abs() < 4.0 * posed.deviations[i] && posed.deviations[i] < 3.0, "{i}: {off} of {}", posed.deviations[i]);
    }
    assert_eq!(posed.lens.distortion, given.distortion);
    // Left as it is, the wrong lens shows.
    let fixed = pose_photographs(&given, &surface(), &photographs, LensUse::Fixed, None).unwrap();
    assert_eq!(fixed.lens, given);
    assert!(fixed.rms_px > 5.0 * posed.rms_px, "{} against {}", fixed.rms_px, posed.rms_px);
}

#[test]
fn one_photograph_does_not_determine_a_lens() {
    let photographs = [marked(&lens(), &camera(30.0, 10.0, 0.7), 0.1, None)];
    for lens_use in [LensUse::RefinePinhole, LensUse::RefineAll] {
        let result = pose_photographs(&lens(), &surface(), &photographs, lens_use, None);
        assert!(matches!(result, Err(CalibrationError::Undetermined { .. })), "{result:?}");
    }
}

#[test]
fn wrong_corners_are_named_with_their_photograph() {
    let good = marked(&lens(), &camera(30.0, 40.0, 0.7), 0.0, None);
    let broken = |change: &dyn Fn(&mut Vec<DVec2>)| {
        let mut photograph = good.clone();
        change(&mut photograph.corners_px);
        pose_photographs(&lens(), &surface(), &[photograph], LensUse::Fixed, None).unwrap_err()
    };
    let file = || String::from("a.jpg");
    assert_eq!(broken(&|c| c.truncate(3)), CalibrationError::CornerCount { found: 3, expected: 4, file: file() });
    assert!(matches!(broken(&|c| c[1].y = f64::INFINITY), CalibrationError::NotFinite { corner: 1, .. }));
    assert_eq!(broken(&|c| c.reverse()), CalibrationError::Clockwise { file: file() });
    assert_eq!(broken(&|c| c.swap(1, 2)), CalibrationError::NoRectangle { file: file() });
    assert_eq!(broken(&|c| c[1] = 0.5 * (c[0] + c[2])), CalibrationError::NoRectangle { file: file() });
    assert_eq!(broken(&|c| c[2] = c[1]), CalibrationError::NoRectangle { file: file() });
    assert!(matches!(broken(&|c| c[0] *= 0.8), CalibrationError::Misfit { .. }));
    // Beyond the fold of this lens, at 0.61 focal lengths.
    let fisheye = Lens { distortion: Distortion::new([-0.4, 0.0, 0.0, 0.0]).unwrap(), ..lens() };
    let mut outside = good.clone();
    outside.corners_px.iter_mut().for_each(|p| *p += DVec2::new(1500.0, 0.0));
    let result = pose_photographs(&fisheye, &surface(), &[outside], LensUse::Fixed, None);
    assert_eq!(result.unwrap_err(), CalibrationError::NoPose { file: file() });
    let other = MarkedPhotograph { size_px: [1200, 1600], ..good.clone() };
    let other = pose_photographs(&lens(), &surface(), &[other], LensUse::Fixed, None).unwrap_err();
    assert_eq!(other, CalibrationError::Size { found: [1200, 1600], expected: [1600, 1200], file: file() });
    assert!(matches!(Surface::new(0.3, f64::NAN), Err(CalibrationError::Surface { .. })));
    let none = pose_photographs(&lens(), &surface(), &[], LensUse::Fixed, None).unwrap_err();
    assert_eq!(none, CalibrationError::TooFewPhotographs { found: 0, least: 1 });
}

#[test]
fn a_camera_behind_the_surface_is_told_as_clockwise_corners() {
    let mut behind = camera(30.0, 40.0, 0.7);
    // Turned half round about the surface's x axis.
    let turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    behind.rotation *= turn;
    behind.translation += behind.rotation * DVec3::new(0.0, -0.21, 0.0);
    assert!(behind.position().z < 0.0);
    let result = pose_photographs(&lens(), &surface(), &[marked(&lens(), &behind, 0.0, None)], LensUse::Fixed, None);
    assert_eq!(result.unwrap_err(), CalibrationError::Clockwise { file: "a.jpg".into() });
}

#[test]
fn no_four_points_make_it_panic_or_give_a_camera_that_misses_them() {
    let mut random = Pcg64Mcg::seed_from_u64(11);
    let mut posed = 0;
    for round in 0..3000 {
        // From a hundredth of a pixel to far beyond any image.
        let scale = 10f64.powi(round % 15 - 2);
        let corners_px = (0..4).map(|_| DVec2::new(800.0, 600.0) + scale * normal(&mut random)).collect();
        let photograph = MarkedPhotograph { file: String::new(), size_px: lens().size_px, corners_px, near: None };
        if let Ok(all) = pose_photographs(&lens(), &surface(), &[photograph], LensUse::Fixed, None) {
            assert!(all.rms_px <= greatest_rms_px(&lens()) && all.photographs[0].camera.camera.pose().position().z > 0.0);
            posed += 1;
        }
    }
    // Those of some pixels across, which any pose far away explains: the loop is not idle.
    assert!(posed > 30, "{posed}");
}

#[test]
fn where_the_noise_is_known_the_corners_never_decide_for_the_wrong_pose() {
    let mut random = Pcg64Mcg::seed_from_u64(5);
    let (mut by_corners, mut misleading) = (0, 0);
    for i in 0..400 {
        let noise_px = [0.5, 1.0][i % 2];
        // From ever farther away through ever longer lenses: the sheet stays 500 px wide and loses its perspective.
        let farther = [1.0, 4.0, 12.0, 30.0][i / 2 % 4];
        let lens = Lens { focal_px: 1800.0 * DVec2::splat(farther), ..tele() };
        let truth = camera(10.0 + 65.0 * (i as f64 / 400.0), 137.0 * i as f64, farther);
        let mut photograph = marked(&lens, &truth, 0.0, None);
        photograph.corners_px.iter_mut().for_each(|p| *p += noise_px * normal(&mut random));
        let posed = pose_photographs(&lens, &surface(), &[photograph], LensUse::Fixed, Some(noise_px)).unwrap().photographs.remove(0);
        let wrong = posed.rival.is_some_and(|(rival, _)| apart(&rival, &truth) < apart(&posed.camera, &truth));
        match posed.decided_by {
            DecidedBy::Corners => {
                // Log odds of 8: once in 3000 such decisions.
                assert!(!wrong, "photograph {i}");
                by_corners += 1;
            }
            _ => misleading += i32::from(wrong),
        }
    }
    assert!(by_corners > 200, "{by_corners} of 400 decided");
    assert!(misleading > 0, "the better fitting pose is wrong somewhere, or the question is idle");
}
