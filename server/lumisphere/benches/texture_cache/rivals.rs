//! The rivals: small programs outside of the product, run on the same files. One that is missing fails the benchmark.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::data::{FACES, SIZE};

/// What a rival printed: name, value.
pub type Values = BTreeMap<String, f64>;

fn program(variable: &str, usual: &str) -> PathBuf {
    let usual = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(usual);
    std::env::var_os(variable).map_or(usual, PathBuf::from)
}

fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("rival missing, see the head of this benchmark: {command:?}: {error}"));
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn values(text: &str) -> Values {
    let values = text.lines().filter_map(|line| line.split_once(' ')).filter_map(|(name, value)| Some((name.into(), value.parse().ok()?)));
    values.collect()
}

fn sized(command: &mut Command, folder: &Path) -> String {
    run(command.arg(folder).args([FACES.to_string(), SIZE.to_string(), super::CACHE_FACES.to_string()]))
}

pub fn oiio_textures(folder: &Path) -> Values {
    let text = sized(&mut Command::new(program("OIIO_TEXTURES", "target/oiio_textures")), folder);
    println!("OpenImageIO through C++: {}", text.lines().next().unwrap_or_default());
    values(&text)
}

pub fn oiio_misses(folder: &Path) -> Values {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/rivals/oiio_misses.py");
    let text = sized(Command::new(program("OIIO_PYTHON", "target/oiio/bin/python")).arg(script), folder);
    println!("OpenImageIO through Python: {}", text.lines().next().unwrap_or_default());
    values(&text)
}

/// One line of `cache_policies`.
pub struct PolicyResult {
    pub name: String,
    pub capacity: u64,
    pub misses: u64,
    /// Pages held at once; a cache that held more than it was given is no rival at equal bytes.
    pub most: u64,
}

pub fn cache_policies(folder: &Path, capacities: &[u64]) -> Vec<PolicyResult> {
    let mut command = Command::new(program("CACHE_POLICIES", "target/rivals/release/cache_policies"));
    let text = run(command.arg(folder.join("visits.u32")).args(capacities.iter().map(u64::to_string)));
    let result = |line: &str| {
        let mut words = line.split(' ');
        let name = words.next()?.to_string();
        let mut number = || words.next()?.parse().ok();
        Some(PolicyResult { name, capacity: number()?, misses: number()?, most: number()? })
    };
    text.lines().map(|line| result(line).unwrap_or_else(|| panic!("cache_policies printed {line:?}"))).collect()
}
