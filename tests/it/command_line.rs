//! Exit codes and JSON of the command line, as `docs/command-line.md` promises.

use std::fs;
use std::process::{Command, Stdio};

use serde_json::Value;

use crate::killed::SLOW;
use crate::process::{Server, binary, temporary_folder};
use crate::tiny::{self, DATASET, QUICK};

fn exit_code(server: &Server, arguments: &[&str]) -> i32 {
    server.lumisphere(arguments).status.code().expect("ended by itself")
}

#[test]
fn exit_codes_tell_what_went_wrong() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let out = folder.path().join("out");
    let out = out.to_str().unwrap();
    let cases: [(&[&str], i32); 11] = [
        (&["dataset", "list"], 0),
        (&["dataset", "get"], 2),
        (&["dataset", "create", "NOT A NAME"], 2),
        (&["render", "--dataset", "x", "--out", out, "--blend", "nearest"], 2),
        (&["dataset", "get", "nothing"], 3),
        (&["job", "get", "job-999999"], 3),
        (&["job", "submit", "capture", "--scene", "missing.json", "--object", "o", "--dataset", "d"], 3),
        (&["job", "submit", "capture", "--scene", "no_such_scene", "--object", "o", "--dataset", "d"], 2),
        (&["dataset", "create", "empty"], 0),
        (&["dataset", "create", "empty"], 7),
        (&["render", "--dataset", "empty", "--out", out], 7),
    ];
    for (arguments, expected) in cases {
        assert_eq!(exit_code(&server, arguments), expected, "{arguments:?}");
    }
    let url = server.url.clone();
    assert_eq!(server.stop(), Some(0));
    let gone = Command::new(binary("lumisphere")).args(["dataset", "list", "--server", &url]).output().unwrap();
    assert_eq!(gone.status.code(), Some(5), "{}", String::from_utf8_lossy(&gone.stderr));
}

#[test]
fn a_failed_job_is_exit_code_6_with_its_reason() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    // Nothing of the box is in this view, so there is nothing to measure.
    let away = ["--position", "0,1,3", "--target", "0,1,6", "--size", "16x16", "--truth-samples-per-pixel", "1"];
    let output = server.lumisphere(&[&["evaluate", "--dataset", DATASET, "--json", "--quiet"], &away[..]].concat());
    assert_eq!(output.status.code(), Some(6), "{}", String::from_utf8_lossy(&output.stderr));
    let error: Value = serde_json::from_slice(&output.stderr).unwrap();
    assert_eq!(error["error"]["exit_code"], 6);
    assert!(error["error"]["message"].as_str().unwrap().contains("box"), "{error}");
}

#[test]
fn errors_are_json_when_asked_for_and_name_the_field() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let out = folder.path().join("out");
    let arguments = ["render", "--dataset", DATASET, "--out", out.to_str().unwrap(), "--position", "0,1,3", "--size", "0x10", "--json"];
    let output = server.lumisphere(&arguments);
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(2), &[][..]));
    let text = String::from_utf8(output.stderr).unwrap();
    let error: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    assert_eq!(error["error"]["code"], "INVALID_ARGUMENT", "{error:#}");
    let field = error["error"]["violations"][0]["field"].as_str().unwrap();
    assert!(field.contains("intrinsics"), "{error:#}");
    assert_eq!(fs::read_dir(&out).unwrap().count(), 0, "a refused render leaves files");
}

#[test]
fn files_are_not_overwritten_unless_forced() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let out = folder.path().join("out");
    let arguments = ["render", "--dataset", DATASET, "--frames", "2", "--size", "16x12", "--out", out.to_str().unwrap()];
    server.succeed(&arguments);
    fs::write(out.join("frame-00001.png"), "mine").unwrap();
    fs::remove_file(out.join("frame-00000.png")).unwrap();
    assert_eq!(exit_code(&server, &arguments), 7);
    assert_eq!(fs::read(out.join("frame-00001.png")).unwrap(), b"mine");
    assert!(!out.join("frame-00000.png").exists(), "work was done before the refusal");
    server.succeed(&[&arguments[..], &["--force"]].concat());
    assert_ne!(fs::read(out.join("frame-00001.png")).unwrap(), b"mine");
}

#[test]
fn ctrl_c_leaves_the_job_running_and_says_how_to_see_it_again() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = tiny::write_scene(&folder.path().join("scene"));
    let long = ["--points", "400", "--face-size-texels", "64", "--samples-per-texel", "64"];
    let capture = ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", DATASET];
    let job = server.json(&[&capture[..], &long].concat());
    let name = job["name"].as_str().unwrap();
    let mut watcher =
        server.lumisphere_command(&["job", "watch", name, "--json"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // It follows the job: its first event is there.
    let mut events = std::io::BufReader::new(watcher.stdout.take().unwrap());
    std::io::BufRead::read_line(&mut events, &mut String::new()).unwrap();
    Command::new("sh").args(["-c", &format!("kill -INT {}", watcher.id())]).status().unwrap();
    let output = watcher.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    assert!(String::from_utf8_lossy(&output.stderr).contains(&format!("lumisphere job watch {name}")));
    let state = server.json(&["job", "get", name])["state"].as_str().unwrap().to_string();
    assert!(["RUNNING", "PENDING", "SUCCEEDED"].contains(&state.as_str()), "{state}");
    if state != "SUCCEEDED" {
        server.succeed(&["job", "cancel", name]);
        assert_eq!(exit_code(&server, &["job", "watch", name, "--quiet"]), 6);
    }
}

#[test]
fn a_repeated_upload_sends_nothing() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let file = folder.path().join("light.bin");
    fs::write(&file, vec![3u8; 3 << 20]).unwrap();
    let arguments = ["blob", "upload", file.to_str().unwrap(), "--quiet"];
    assert_eq!(server.json(&arguments)["sent_bytes"], 3 << 20);
    let again = server.json(&arguments);
    assert_eq!(again["sent_bytes"], 0);
    let out = folder.path().join("copy.bin");
    server.succeed(&["blob", "download", again["blake3"].as_str().unwrap(), "--out", out.to_str().unwrap(), "--quiet"]);
    assert_eq!(fs::read(&out).unwrap(), fs::read(&file).unwrap());
}

#[test]
fn the_configuration_file_is_below_environment_and_flag_and_refuses_unknown_keys() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let config = folder.path().join("client.toml");
    let run = |text: &str, environment: Option<&str>, flags: &[&str]| {
        fs::write(&config, text).unwrap();
        let mut command = server.lumisphere_command(&["system", "version", "--config", config.to_str().unwrap()]);
        command.env_remove("LUMISPHERE_SERVER").args(flags);
        if let Some(url) = environment {
            command.env("LUMISPHERE_SERVER", url);
        }
        command.output().unwrap().status.code().unwrap()
    };
    // Port 9 (discard) of the loopback: nobody listens.
    let (right, wrong) = (format!("server = \"{}\"\n", server.url), "server = \"http://127.0.0.1:9\"\n");
    assert_eq!(run(&right, None, &[]), 0);
    assert_eq!(run(wrong, None, &[]), 5);
    assert_eq!(run(wrong, Some(&server.url), &[]), 0);
    assert_eq!(run(&right, Some("http://127.0.0.1:9"), &["--server", &server.url]), 0);
    assert_eq!(run("sevrer = \"x\"\n", None, &[]), 2);
}

#[test]
fn every_command_of_the_command_line_answers_in_json() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let has = |document: &Value, keys: &[&str]| {
        for key in keys {
            assert!(document.get(key).is_some(), "{key} is missing in {document:#}");
        }
    };
    has(&server.json(&["system", "version"]), &["client", "server", "api", "features"]);
    has(&server.json(&["system", "info"]), &["backend", "adapter", "limits", "configuration", "uptime_seconds"]);
    has(&server.json(&["cache", "stats"]), &["tiers", "texels", "datasets", "strategy"]);
    has(&server.json(&["dataset", "files", DATASET]), &["dataset", "version", "files"]);
    has(&server.json(&["job", "get", "job-000001"]), &["name", "state", "result", "attempt"]);
    let orbit = ["--frames", "1", "--size", "16x12"];
    let path = server.json(&[&["job", "submit", "path-render", "--dataset", DATASET, "--watch", "--quiet"], &orbit[..]].concat());
    assert_eq!(path["result"]["blobs"][0]["name"], "frame-00000.png", "{path:#}");
    let out = folder.path().join("path");
    let fetched = server.json(&["job", "download", path["name"].as_str().unwrap(), "--out", out.to_str().unwrap(), "--quiet"]);
    assert_eq!(fetched["files"][0], "frame-00000.png");
    // A repeated request ID is the same job, not a second version.
    let scene = folder.path().join("scene/scene.json");
    let submit =
        ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", "twice", "--request-id", "one"];
    let first = server.json(&[&submit[..], &QUICK].concat());
    assert_eq!(server.json(&[&submit[..], &QUICK].concat())["name"], first["name"]);
}

#[test]
fn completion_scripts_know_the_nouns_of_every_shell() {
    for shell in ["bash", "zsh", "fish"] {
        let output = Command::new(binary("lumisphere")).args(["completions", shell]).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{shell}");
        assert!(String::from_utf8_lossy(&output.stdout).contains("dataset"), "{shell}: no noun in the script");
    }
}

#[test]
fn progress_goes_to_standard_error_and_json_alone_to_standard_output() {
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    let scene = tiny::write_scene(&folder.path().join("scene"));
    let submit = ["job", "submit", "capture", "--scene", scene.to_str().unwrap(), "--object", "box", "--dataset", DATASET];
    let output = server.lumisphere(&[&submit[..], &["--watch", "--json"], &SLOW].concat());
    let (result, talk) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let job: Value = serde_json::from_str(&result).unwrap_or_else(|e| panic!("{e} in {result}"));
    assert_eq!(job["state"], "SUCCEEDED");
    // Where there is no terminal: lines, of the upload and then of the job.
    assert!(talk.contains("\nuploading "), "no upload in {talk:?}");
    let of_job = talk.split("submitted job-000001\n").nth(1);
    assert!(of_job.is_some_and(|lines| lines.lines().any(|line| line.contains(": "))), "no progress of the job in {talk:?}");
}
