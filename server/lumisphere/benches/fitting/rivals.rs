//! The rivals: small programs outside of the product, run on the same samples. One that is missing fails the benchmark.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::maps::Map;

/// What a rival printed: name, value.
pub type Values = BTreeMap<String, f64>;

fn program(variable: &str, usual: &str) -> PathBuf {
    let usual = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(usual);
    std::env::var_os(variable).map_or(usual, PathBuf::from)
}

fn values(command: &mut Command, samples: &Path, map: &Map, lobes: usize) -> Values {
    command.arg(samples).args([map.texels(), map.views(), lobes].map(|n| n.to_string()));
    let output = command.output().unwrap_or_else(|error| panic!("rival missing, see the head of this benchmark: {command:?}: {error}"));
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().filter_map(|line| line.split_once(' ')).filter_map(|(name, value)| Some((name.into(), value.parse().ok()?))).collect()
}

pub fn ceres(samples: &Path, map: &Map, lobes: usize) -> Values {
    values(&mut Command::new(program("CERES_LOBES", "target/ceres_lobes")), samples, map, lobes)
}

pub fn scipy(samples: &Path, map: &Map, lobes: usize) -> Values {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/rivals/scipy_lobes.py");
    values(Command::new(program("SCIPY_PYTHON", "target/scipy/bin/python")).arg(script), samples, map, lobes)
}
