//! `lumisphere stream`: every frame, in order, in a folder, a video or a pipe.

use std::fs;
use std::io::Read;
use std::path::Path;
use std::process::Stdio;

use serde_json::Value;

use crate::pictures::{Picture, rendered};
use crate::process::{Server, ended, signal, temporary_folder};
use crate::tiny::{self, DATASET};

/// Odd, so that four pixels do not always share a colour.
const ORBIT: [&str; 8] = ["--frames", "5", "--size", "41x31", "--component", "full", "--blend", "average"];

/// A difference of codes that rounding Y′, C_B and C_R to 8 bits makes: half a step of each, in limited range 0.58 of luma and at most 1.06 of
/// chroma (blue, 1.8556 · 255/224 / 2).
const ROUNDING: f32 = 1.7;

fn server_with_dataset(folder: &Path, flags: &[&str]) -> Server {
    let server = Server::start_with(&folder.join("data"), flags);
    tiny::capture(&server, folder);
    server
}

fn stream<'a>(flags: &[&'a str], out: &'a str) -> Vec<&'a str> {
    [&["stream", "--dataset", DATASET, "--out", out, "--quiet"], &ORBIT[..], flags].concat()
}

/// A YUV4MPEG2 file: the header's words, and of each frame its three planes.
fn parsed(bytes: &[u8]) -> (Vec<String>, Vec<[&[u8]; 3]>) {
    let end = bytes.iter().position(|b| *b == b'\n').expect("a header");
    let words: Vec<String> = std::str::from_utf8(&bytes[..end]).unwrap().split(' ').map(String::from).collect();
    assert_eq!(words[0], "YUV4MPEG2");
    let (width, height) = size(&words);
    let colours = if words.contains(&"C444".into()) { width * height } else { width.div_ceil(2) * height.div_ceil(2) };
    let mut rest = &bytes[end + 1..];
    let mut frames = Vec::new();
    while !rest.is_empty() {
        rest = rest.strip_prefix(b"FRAME\n").expect("a frame begins");
        let (luma, after) = rest.split_at(width * height);
        let (blue, after) = after.split_at(colours);
        let (red, after) = after.split_at(colours);
        frames.push([luma, blue, red]);
        rest = after;
    }
    (words, frames)
}

fn size(words: &[String]) -> (usize, usize) {
    let side = |key: char| words.iter().find_map(|word| word.strip_prefix(key)?.parse().ok()).unwrap();
    (side('W'), side('H'))
}

/// As a player shows it, by the inverse matrix of ITU-R BT.709-6; neither rounded nor clipped.
fn shown(words: &[String], [luma, blue, red]: [&[u8]; 3]) -> Picture {
    let width = size(words).0;
    let is_full = words.contains(&"XCOLORRANGE=FULL".into());
    assert!(is_full || words.contains(&"XCOLORRANGE=LIMITED".into()), "{words:?}");
    let (black, luma_scale, chroma_scale) = if is_full { (0.0, 1.0, 1.0) } else { (16.0, 255.0 / 219.0, 255.0 / 224.0) };
    let place = |at: usize| match blue.len() == luma.len() {
        true => at,
        false => at / width / 2 * width.div_ceil(2) + at % width / 2,
    };
    let pixel = |at: usize| {
        let y = luma_scale * (f32::from(luma[at]) - black);
        let [b, r] = [blue, red].map(|plane| chroma_scale * (f32::from(plane[place(at)]) - 128.0));
        [y + 1.5748 * r, y - 0.187_324 * b - 0.468_124 * r, y + 1.8556 * b]
    };
    Picture { width, pixels: (0..luma.len()).map(pixel).collect() }
}

#[test]
fn a_video_shows_what_render_shows_in_the_same_order() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    let truth: Vec<Picture> = rendered(&server, folder.path(), &ORBIT).iter().map(|png| Picture::of_png(png)).collect();
    let out = folder.path().join("film.y4m");
    // Four pixels that share a colour have its mean; without that, each has its own.
    for (flags, header, block) in [
        (&[][..], "W41 H31 F30:1 XCOLORRANGE=LIMITED C444", 1),
        (&["--range", "full", "--fps", "24000/1001", "--force"], "W41 H31 F24000:1001 XCOLORRANGE=FULL C444", 1),
        (&["--chroma", "420", "--force"], "W41 H31 F30:1 XCOLORRANGE=LIMITED C420jpeg", 2),
    ] {
        let summary = server.json(&stream(flags, out.to_str().unwrap()));
        let bytes = fs::read(&out).unwrap();
        let (words, frames) = parsed(&bytes);
        assert_eq!(words[1..].join(" "), header);
        assert_eq!((frames.len(), summary["frames"].as_u64(), summary["bytes"].as_u64()), (5, Some(5), Some(bytes.len() as u64)));
        let percentile = |key: &str| summary[key].as_f64().unwrap();
        assert!(percentile("millis_median") > 0.0 && percentile("millis_median") <= percentile("millis_p95"), "{summary:#}");
        for (index, planes) in frames.iter().enumerate() {
            let picture = shown(&words, *planes).means(block);
            let worst = picture.worst(&truth[index].means(block));
            assert!(worst <= ROUNDING, "{header}, frame {index}: {worst}");
            // Any other frame of the path is told from it.
            for other in (0..5).filter(|other| *other != index) {
                assert!(picture.worst(&truth[other].means(block)) > 4.0 * ROUNDING, "{header}: frames {index} and {other} look the same");
            }
        }
    }
}

#[test]
fn a_folder_holds_the_files_that_render_writes() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    for format in ["png", "exr"] {
        let truth = rendered(&server, folder.path(), &[&ORBIT[..], &["--format", format]].concat());
        let out = folder.path().join(format);
        let summary = server.json(&stream(&["--format", format], out.to_str().unwrap()));
        assert_eq!(summary["bytes"].as_u64().unwrap(), truth.iter().map(|file| file.len() as u64).sum::<u64>());
        for (index, file) in truth.iter().enumerate() {
            assert!(fs::read(out.join(format!("frame-{index:05}.{format}"))).unwrap() == *file, "frame {index} of {format}");
        }
        assert_eq!(fs::read_dir(&out).unwrap().count(), 5);
    }
}

#[test]
fn cameras_of_a_file_come_once_or_over_and_over_and_paths_differ() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    let (scene, out) = (folder.path().join("scene/scene.json"), folder.path().join("film.y4m"));
    let scene = scene.to_str().unwrap();
    let film = |flags: &[&str]| {
        let base = ["stream", "--dataset", DATASET, "--out", out.to_str().unwrap(), "--quiet", "--force"];
        server.json(&[&base[..], flags].concat());
        fs::read(&out).unwrap()
    };
    let once = film(&["--cameras", scene]);
    let (words, frames) = parsed(&once);
    assert_eq!((size(&words), frames.len()), ((48, 32), 2));
    let thrice = film(&["--cameras", scene, "--path", "replayed", "--frames", "3"]);
    let (_, again) = parsed(&thrice);
    assert_eq!(again, [frames[0], frames[1], frames[0]]);
    let films = ["orbit", "walk", "jump"].map(|path| film(&["--path", path, "--frames", "3", "--size", "16x12"]));
    assert!(films[0] != films[1] && films[1] != films[2] && films[0] != films[2]);
}

#[test]
fn standard_output_is_the_video_and_nothing_else() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    let out = folder.path().join("film.y4m");
    server.json(&stream(&[], out.to_str().unwrap()));
    let piped = server.lumisphere(&stream(&["--json"], "-"));
    assert!(piped.status.success(), "{}", String::from_utf8_lossy(&piped.stderr));
    assert!(piped.stdout == fs::read(&out).unwrap(), "{} bytes", piped.stdout.len());
    let summary: Value = serde_json::from_slice(&piped.stderr).unwrap();
    assert_eq!((summary["out"].as_str(), summary["bytes"].as_u64()), (Some("-"), Some(piped.stdout.len() as u64)));
}

#[test]
fn a_reader_that_leaves_ends_the_stream_quietly_and_one_that_stands_still_can_be_interrupted() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    // More than any pipe holds: 13 KB a frame.
    let endless = ["stream", "--dataset", DATASET, "--out", "-", "--quiet", "--frames", "100000", "--size", "64x69"];
    for (sent, expected) in [(None, 0), (Some("INT"), 130)] {
        let mut child = server.lumisphere_command(&endless).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut stdout = child.stdout.take().unwrap();
        stdout.read_exact(&mut [0; 64]).unwrap();
        let kept = match sent {
            Some(name) => {
                signal(&child, name);
                Some(stdout)
            }
            None => {
                drop(stdout);
                None
            }
        };
        let code = ended(&mut child).expect("it ends").code();
        let mut talk = String::new();
        child.stderr.take().unwrap().read_to_string(&mut talk).unwrap();
        assert_eq!((code, talk.is_empty()), (Some(expected), sent.is_none()), "{talk}");
        drop(kept);
    }
}

#[test]
fn nothing_is_overwritten_or_left_in_half_and_what_cannot_be_is_refused() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &[]);
    let films = folder.path().join("films");
    fs::create_dir(&films).unwrap();
    let film = films.join("film.y4m");
    fs::write(&film, "mine").unwrap();
    let scene = folder.path().join("two-sizes.json");
    let text = fs::read_to_string(folder.path().join("scene/scene.json")).unwrap();
    fs::write(&scene, text.replacen("\"width\": 48", "\"width\": 40", 1)).unwrap();
    let other = films.join("other.y4m");
    let [film_text, other, scene] = [&film, &other, &scene].map(|path| path.to_str().unwrap());
    let code = |dataset: &str, out: &str, flags: &[&str]| {
        let output = server.lumisphere(&[&["stream", "--dataset", dataset, "--out", out, "--quiet"], flags].concat());
        assert!(output.status.success() || output.stdout.is_empty());
        output.status.code().unwrap()
    };
    for (dataset, out, flags, expected) in [
        (DATASET, film_text, &["--frames", "1"][..], 7),
        (DATASET, other, &["--format", "exr"], 2),
        (DATASET, "-", &["--depth"], 2),
        (DATASET, other, &["--cameras", scene], 2),
        (DATASET, other, &["--cameras", scene, "--path", "walk"], 2),
        (DATASET, other, &["--path", "replayed"], 2),
        (DATASET, other, &["--fps", "0"], 2),
        // The server's no, when the file is there already in part.
        (DATASET, other, &["--size", "0x10"], 2),
        ("nothing", other, &[], 3),
    ] {
        assert_eq!(code(dataset, out, flags), expected, "{flags:?}");
    }
    assert_eq!(fs::read_dir(&films).unwrap().count(), 1, "something is left");
    assert_eq!(fs::read(&film).unwrap(), b"mine");
    assert_eq!(code(DATASET, film_text, &["--frames", "1", "--force"]), 0);
    assert!(fs::read(&film).unwrap().starts_with(b"YUV4MPEG2 "));
}

/// More pages than a viewer's frame waits for, as in `clients`: the first frame of a pose shows coarse texels.
#[test]
fn every_frame_is_final_unless_first_ones_are_asked_for() {
    let folder = temporary_folder();
    let server = server_with_dataset(folder.path(), &["--gpu-upload-bytes-per-frame", "8192"]);
    if server.json(&["system", "info"])["adapter"] == "" {
        assert!(std::env::var_os("REQUIRE_GPU").is_none(), "no adapter");
        return;
    }
    let flags = ["--frames", "2", "--size", "320x240"];
    let first = |flag: &str| {
        let out = folder.path().join(format!("out{flag}"));
        let base = ["stream", "--dataset", DATASET, "--out", out.to_str().unwrap(), "--quiet"];
        let more = if flag.is_empty() { vec![] } else { vec![flag] };
        server.json(&[&base[..], &flags, &more].concat());
        fs::read(out.join("frame-00000.png")).unwrap()
    };
    // In this order: coarse texels are shown before the pages have come.
    let (unrefined, refined) = (first("--unrefined"), first(""));
    let unary = rendered(&server, folder.path(), &flags);
    assert!(refined == unary[0], "a frame of the stream is not the final one");
    assert!(unrefined != unary[0], "the test needs a dataset whose frame exceeds the cap");
    server.succeed(&["cache", "clear"]);
    assert!(rendered(&server, folder.path(), &[&flags[..], &["--stream"]].concat()) == unary, "render --stream");
}

#[test]
fn a_video_that_is_cut_or_has_something_between_its_frames_is_none_to_these_tests() {
    let whole = b"YUV4MPEG2 W2 H1 F1:1 XCOLORRANGE=FULL C444\nFRAME\nabcdef";
    assert_eq!(parsed(whole).1, [[&b"ab"[..], b"cd", b"ef"]]);
    for bad in [&whole[..whole.len() - 1], b"YUV4MPEG2 W2 H1 C444\nFRAMEXabcdef", b"P6 W2 H1 C444\nFRAME\nabcdef"] {
        assert!(std::panic::catch_unwind(|| drop(parsed(bad))).is_err());
    }
}
