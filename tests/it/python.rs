//! `docs/examples/orbit.py`: a client in another language, with stubs generated from the same files.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::pictures::{Picture, rendered};
use crate::process::{Server, temporary_folder};
use crate::tiny::{self, DATASET};

/// That of `.venv`, which `tests/run` makes, or of the machine, if it has gRPC; else the test is left out, unless `REQUIRE_PYTHON` is set.
fn python(repository: &Path) -> Option<PathBuf> {
    let candidates = [repository.join(".venv/bin/python"), "python3".into()];
    let has_grpc =
        |python: &&PathBuf| Command::new(python).args(["-c", "import grpc, grpc_tools"]).output().is_ok_and(|o| o.status.success());
    let found = candidates.iter().find(has_grpc).cloned();
    assert!(
        found.is_some() || std::env::var_os("REQUIRE_PYTHON").is_none(),
        "no Python with grpcio and grpcio-tools: deploy/ensure-python"
    );
    found
}

#[test]
fn the_python_example_shows_the_orbit_that_render_shows() {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let Some(python) = python(repository) else {
        eprintln!("left out: no Python with grpcio and grpcio-tools (deploy/ensure-python makes one)");
        return;
    };
    let folder = temporary_folder();
    let server = Server::start(&folder.path().join("data"));
    tiny::capture(&server, folder.path());
    let out = folder.path().join("frames");
    let mut example = Command::new(python);
    example.arg(repository.join("docs/examples/orbit.py")).args([DATASET, "--frames", "3", "--size", "48x36", "--out"]).arg(&out);
    let said = example.args(["--server", &server.address().host]).output().unwrap();
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let pngs = rendered(&server, folder.path(), &["--frames", "3", "--size", "48x36"]);
    for index in 0..3 {
        let frame = Picture::of_png(&std::fs::read(out.join(format!("frame-{index:05}.png"))).unwrap());
        // The same camera in double precision: a code may round the other way, an edge may touch another pixel.
        assert!(frame.mean(&Picture::of_png(&pngs[index])) < 0.1, "frame {index}");
        assert!(frame.mean(&Picture::of_png(&pngs[(index + 1) % 3])) > 1.0, "frame {index} is any frame");
    }
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 3);
}
