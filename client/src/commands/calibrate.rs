//! `lumisphere calibrate`: the lens from photographs of a checkerboard, then the pose of each photograph of a surface from its four corners.
//! Asks no server; what comes out goes to `job submit import`.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::{Args, Subcommand, ValueEnum};
use glam::{DVec2, DVec3, Vec3};
use lumisphere::capture::calibration::{
    BoardPhotograph, Calibration, CalibrationError, Checkerboard, DecidedBy, Detection, Grey, LEAST_PHOTOGRAPHS, Lens, LensUse,
    MarkedPhotograph, PosedPhotographs, Surface, calibrate, find_checkerboard, pose_photographs,
};
use lumisphere::formats::marked_corners::MarkedPicture;
use lumisphere::formats::photograph_list::CalibratedPicture;
use lumisphere::formats::{lens, marked_corners, photograph_list};
use lumisphere::geometry::{Camera, PhotographCamera, Pose};
use lumisphere::images::{ReadLimits, decode_image, decode_image_codes};
use serde_json::{Value, json};

use crate::context::Context;
use crate::exit::Failure;
use crate::files::{Existing, write_atomically};
use crate::output::table;
use crate::progress::{Meter, Progress};

/// What to calibrate.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Focal length, principal point and distortion from photographs of a checkerboard
    Lens(LensArguments),
    /// Where each photograph of a flat surface was taken from, by the surface's four corners
    Poses(PosesArguments),
}

/// Flags of `calibrate lens`.
#[derive(Debug, Args)]
pub struct LensArguments {
    /// Photographs of the board, three at least, tilted differently (JPEG, PNG, TIFF)
    #[arg(value_name = "PHOTOGRAPH", required = true)]
    photographs: Vec<PathBuf>,
    /// Inner corners of the board: one less than squares, each way
    #[arg(long, value_name = "COLUMNSxROWS", value_parser = parse_board)]
    board: [usize; 2],
    /// Side of a square, any unit
    #[arg(long, value_name = "LENGTH", default_value_t = 1.0)]
    square: f64,
    /// Write the lens into this file (JSON)
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the file
    #[arg(long)]
    force: bool,
}

/// Flags of `calibrate poses`.
#[derive(Debug, Args)]
pub struct PosesArguments {
    /// Corners of the surface in each photograph (lumisphere-corners/1; docs/command-line.md)
    #[arg(value_name = "CORNERS.JSON")]
    corners: PathBuf,
    /// What `calibrate lens --out` wrote
    #[arg(long, value_name = "FILE")]
    lens: PathBuf,
    /// Of the surface, along x; any unit
    #[arg(long, value_name = "LENGTH")]
    width: f64,
    /// Of the surface, along y
    #[arg(long, value_name = "LENGTH")]
    height: f64,
    /// Standard deviation of a marked corner in pixels [default: as the corners tell]
    #[arg(long, value_name = "PX")]
    corner_noise_px: Option<f64>,
    /// What of the lens to adjust with the poses
    #[arg(long, value_enum, default_value = "nothing")]
    refine: Refine,
    /// Write the list of photographs for `job submit import` into this file; in the folder of the corners, since it names photographs as they do
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Overwrite the file
    #[arg(long)]
    force: bool,
}

/// What of the lens is adjusted with the poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Refine {
    /// The lens is taken as it is
    Nothing,
    /// Focal lengths and principal point; many photographs are needed
    Pinhole,
    /// Distortion, too
    All,
}

fn parse_board(text: &str) -> Result<[usize; 2], String> {
    let sides = text.split_once('x').and_then(|(columns, rows)| Some([columns.parse().ok()?, rows.parse().ok()?]));
    sides.ok_or_else(|| format!("{text:?}, inner corners as COLUMNSxROWS expected, for example 9x6"))
}

/// Runs it.
pub fn run(command: &Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::Lens(arguments) => run_lens(arguments, context),
        Command::Poses(arguments) => run_poses(arguments, context),
    }
}

/// A wrong file or photograph is the caller's to put right.
fn usage(error: CalibrationError) -> Failure {
    Failure::Usage(error.to_string())
}

/// Before any work.
fn check_out(out: Option<&Path>, force: bool) -> anyhow::Result<()> {
    match out.filter(|out| !force && out.exists()) {
        Some(out) => Err(Failure::Precondition(format!("{} exists; --force overwrites it", out.display())).into()),
        None => Ok(()),
    }
}

fn run_lens(arguments: &LensArguments, context: &Context) -> anyhow::Result<()> {
    check_out(arguments.out.as_deref(), arguments.force)?;
    let [columns, rows] = arguments.board;
    let board = Checkerboard::new(columns, rows, arguments.square).map_err(usage)?;
    let (mut found, mut missed) = (Vec::new(), Vec::new());
    let mut meter = Meter::new(context.output);
    let total = arguments.photographs.len() as u64;
    for (done, path) in arguments.photographs.iter().enumerate() {
        meter.update(Progress { stage: "looking for the board", done: done as u64, total, seconds_left: None, detail: "" });
        let name = path.display().to_string();
        match detected(path, &board)? {
            Ok((size_px, corners_px)) => found.push(BoardPhotograph { file: name, size_px, corners_px }),
            Err(why) => missed.push((name, why)),
        }
    }
    meter.finish();
    missed.iter().for_each(|(name, why)| context.output.say(&format!("{name}: left out, {why}")));
    if found.len() < LEAST_PHOTOGRAPHS {
        let (found, why) = (found.len(), missed.first().map_or(String::new(), |(name, why)| format!(" ({name}: {why})")));
        let problem = format!("the whole board is found in {found} photographs, at least {LEAST_PHOTOGRAPHS} expected{why}");
        return Err(Failure::Usage(problem).into());
    }
    let calibration = calibrate(&board, &found).map_err(usage)?;
    let lens = lens::write(&calibration.photographs[0].camera);
    if let Some(out) = &arguments.out {
        write_atomically(out, &serde_json::to_vec_pretty(&lens)?, Existing::from_force(arguments.force))?;
    }
    let photographs = calibration.photographs.iter().zip(&found);
    let photographs: Vec<Value> = photographs
        .map(|(photograph, board)| {
            let corners: Vec<[f64; 2]> = board.corners_px.iter().map(DVec2::to_array).collect();
            json!({ "file": board.file, "rms_px": photograph.rms_px, "corners_px": corners })
        })
        .collect();
    let left_out: Vec<Value> = missed.iter().map(|(name, why)| json!({ "file": name, "reason": why })).collect();
    let document = json!({
        "lens": lens, "deviations": deviations(&calibration.deviations), "rms_px": calibration.rms_px,
        "photographs": photographs, "left_out": left_out, "out": arguments.out,
    });
    context.output.document(&document, || lens_text(&calibration, &found))?;
    Ok(())
}

type Found = ([u32; 2], Vec<DVec2>);

/// The board's corners in a photograph, or why they are not all there.
fn detected(path: &Path, board: &Checkerboard) -> anyhow::Result<Result<Found, String>> {
    let codes = decode_image_codes(&read(path)?, ReadLimits::SCENE).map_err(|e| Failure::Usage(format!("{}: {e}", path.display())))?;
    let grey = Grey::from_codes(&codes);
    Ok(match find_checkerboard(&grey, board) {
        Detection::Found(corners) => Ok((grey.size_px(), corners)),
        Detection::PartlyOutOfView { found } => {
            Err(format!("the board is partly out of view: {found} of {} corners", board.corner_count()))
        }
        Detection::Incomplete { found } => Err(format!("{found} of {} corners are seen: hidden, or blurred", board.corner_count())),
        Detection::OtherBoard { columns, rows } => Err(format!("it shows a board of {columns}x{rows} inner corners")),
        Detection::NotFound => Err("no checkerboard".into()),
    })
}

fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    std::fs::read(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Failure::NotFound(format!("no such file: {}", path.display())).into(),
        _ => anyhow::Error::from(e).context(format!("cannot read {}", path.display())),
    })
}

const PARAMETERS: [&str; Lens::PARAMETERS] =
    ["focal length x", "focal length y", "principal point x", "principal point y", "k1", "k2", "p1", "p2"];

fn deviations(deviations: &[f64; Lens::PARAMETERS]) -> Value {
    PARAMETERS.iter().zip(deviations).map(|(name, deviation)| (name.replace(' ', "_"), json!(deviation))).collect()
}

fn lens_lines(lens: &Lens, deviations: &[f64; Lens::PARAMETERS]) -> String {
    let line =
        |((name, value), deviation): ((&&str, f64), &f64)| vec![name.to_string(), format!("{value:.5}"), format!("± {deviation:.5}")];
    let rows: Vec<Vec<String>> = PARAMETERS.iter().zip(lens.parameters()).zip(deviations).map(line).collect();
    table(&rows, &[1, 2])
}

fn lens_text(calibration: &Calibration, found: &[BoardPhotograph]) -> String {
    let head = vec!["photograph".to_string(), "rms px".to_string()];
    let line = |(p, board): (&lumisphere::capture::calibration::CalibratedPhotograph, &BoardPhotograph)| {
        vec![board.file.clone(), format!("{:.3}", p.rms_px)]
    };
    let rows: Vec<Vec<String>> = std::iter::once(head).chain(calibration.photographs.iter().zip(found).map(line)).collect();
    let lens = lens_lines(&calibration.lens, &calibration.deviations);
    format!("{}\n\n{lens}\n\n{} photographs, {:.3} px in all", table(&rows, &[1]), found.len(), calibration.rms_px)
}

fn run_poses(arguments: &PosesArguments, context: &Context) -> anyhow::Result<()> {
    if let Some(noise) = arguments.corner_noise_px.filter(|noise| !(*noise > 0.0 && noise.is_finite())) {
        return Err(Failure::Usage(format!("--corner-noise-px {noise}: a number above 0 expected")).into());
    }
    check_out(arguments.out.as_deref(), arguments.force)?;
    let folder = folder_of(&arguments.corners)?;
    if let Some(out) = &arguments.out
        && folder_of(out)? != folder
    {
        let problem = format!("--out {}: a file in {} expected, where the corners are", out.display(), folder.display());
        return Err(Failure::Usage(problem).into());
    }
    let name = |path: &Path| path.display().to_string();
    let wrong = |e: lumisphere::formats::KnownCamerasError| Failure::Usage(e.to_string());
    let lens = Lens::of(&lens::read(&name(&arguments.lens), &read(&arguments.lens)?).map_err(wrong)?);
    let pictures = marked_corners::read(&name(&arguments.corners), &read(&arguments.corners)?).map_err(wrong)?;
    let surface = Surface::new(arguments.width, arguments.height).map_err(usage)?;
    if let Some(length) = [arguments.width, arguments.height].into_iter().find(|length| !(1e-9..=1e9).contains(length)) {
        return Err(Failure::Usage(format!("a surface of {length}, sides of 1e-9 to 1e9 expected")).into());
    }
    // The list's origin is the surface's centre, the calibration's its first corner.
    let center = DVec3::new(arguments.width / 2.0, arguments.height / 2.0, 0.0);
    let marked = pictures.iter().map(|picture| marked(picture, &folder, center)).collect::<anyhow::Result<Vec<_>>>()?;
    let lens_use = match arguments.refine {
        Refine::Nothing => LensUse::Fixed,
        Refine::Pinhole => LensUse::RefinePinhole,
        Refine::All => LensUse::RefineAll,
    };
    let posed = pose_photographs(&lens, &surface, &marked, lens_use, arguments.corner_noise_px).map_err(usage)?;
    for photograph in posed.photographs.iter().filter(|p| p.decided_by == DecidedBy::Nothing) {
        let file = &photograph.camera.file;
        context.output.say(&format!(
            "{file}: two poses explain the corners alike; mark them more exactly, or say `near` in {}",
            name(&arguments.corners)
        ));
    }
    let cameras = posed.photographs.iter().map(|p| centered(&p.camera, center.as_vec3())).collect::<anyhow::Result<Vec<_>>>()?;
    let listed = |(p, camera): (&MarkedPicture, &PhotographCamera)| CalibratedPicture {
        files: p.files.clone(),
        exposures: p.exposures.clone(),
        camera: camera.clone(),
    };
    let listed: Vec<CalibratedPicture> = pictures.iter().zip(&cameras).map(listed).collect();
    if let Some(out) = &arguments.out {
        let list = photograph_list::write([arguments.width, arguments.height], &listed);
        write_atomically(out, &serde_json::to_vec_pretty(&list)?, Existing::from_force(arguments.force))?;
    }
    let photographs: Vec<Value> = posed
        .photographs
        .iter()
        .zip(&cameras)
        .map(|(p, camera)| {
            json!({
                "file": camera.file, "position": camera.camera.pose().position().to_array(), "rms_px": p.rms_px,
                "decided_by": decided(p.decided_by), "rival_rms_px": p.rival.as_ref().map(|(_, rms)| rms),
            })
        })
        .collect();
    let document = json!({
        "photographs": photographs, "rms_px": posed.rms_px, "lens": cameras.first().map(lens::write),
        "deviations": deviations(&posed.deviations), "out": arguments.out,
    });
    context.output.document(&document, || poses_text(&posed, &cameras, arguments.refine))?;
    Ok(())
}

/// Of a file, whether or not it exists; it must.
fn folder_of(file: &Path) -> anyhow::Result<PathBuf> {
    let folder = file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    folder.canonicalize().map_err(|_| Failure::NotFound(format!("no such folder: {}", folder.display())).into())
}

/// A picture as the calibration takes it; all of its files are of one size.
fn marked(picture: &MarkedPicture, folder: &Path, center: DVec3) -> anyhow::Result<MarkedPhotograph> {
    let sizes = picture.files.iter().map(|file| size_px(&folder.join(file))).collect::<anyhow::Result<Vec<_>>>()?;
    let (Some(file), Some(first)) = (picture.files.first(), sizes.first()) else {
        return Err(Failure::Usage("a photograph without file".into()).into());
    };
    if let Some((file, [width, height])) = picture.files.iter().zip(&sizes).find(|(_, size)| *size != first) {
        let problem = format!("{file} is {width}x{height} pixels, {}x{} expected as of the picture's first exposure", first[0], first[1]);
        return Err(Failure::Usage(problem).into());
    }
    let near = picture.near.map(|near| near + center);
    Ok(MarkedPhotograph { file: file.clone(), size_px: *first, corners_px: picture.corners_px.to_vec(), near })
}

fn size_px(path: &Path) -> anyhow::Result<[u32; 2]> {
    let image = decode_image(&read(path)?, ReadLimits::SCENE).map_err(|e| Failure::Usage(format!("{}: {e}", path.display())))?;
    Ok([image.width as u32, image.height as u32])
}

fn centered(photograph: &PhotographCamera, center: Vec3) -> anyhow::Result<PhotographCamera> {
    let (camera, pose) = (&photograph.camera, photograph.camera.pose());
    let pose = Pose::new(pose.rotation(), pose.position() - center).with_context(|| photograph.file.clone())?;
    let camera = Camera::new(*camera.intrinsics(), pose).with_context(|| photograph.file.clone())?;
    Ok(PhotographCamera { camera, ..photograph.clone() })
}

fn decided(by: DecidedBy) -> &'static str {
    match by {
        DecidedBy::OnlyPose => "only pose",
        DecidedBy::Corners => "corners",
        DecidedBy::Hint => "near",
        DecidedBy::Nothing => "nothing",
    }
}

fn poses_text(posed: &PosedPhotographs, cameras: &[PhotographCamera], refine: Refine) -> String {
    let head = ["photograph", "x", "y", "z", "rms px", "decided by"].map(String::from).to_vec();
    let line = |(p, camera): (&lumisphere::capture::calibration::PosedPhotograph, &PhotographCamera)| {
        let [x, y, z] = camera.camera.pose().position().to_array().map(|v| format!("{v:.4}"));
        vec![camera.file.clone(), x, y, z, format!("{:.3}", p.rms_px), decided(p.decided_by).to_string()]
    };
    let rows: Vec<Vec<String>> = std::iter::once(head).chain(posed.photographs.iter().zip(cameras).map(line)).collect();
    let lens = if refine == Refine::Nothing { String::new() } else { format!("\n\n{}", lens_lines(&posed.lens, &posed.deviations)) };
    format!("{}{lens}\n\n{} photographs, {:.3} px in all", table(&rows, &[1, 2, 3, 4]), cameras.len(), posed.rms_px)
}
