//! The repository's own rules, read from its files. Every rule is a function from text to violations, and each has a negative control:
//! a text that breaks the rule must be caught.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").to_path_buf()
}

/// Files below `folder` that `wanted` accepts, without build products and hidden folders; (path relative to the repository, text).
fn texts(folder: &str, wanted: impl Fn(&Path) -> bool) -> Vec<(String, String)> {
    let root = repository();
    let (mut found, mut folders) = (Vec::new(), vec![root.join(folder)]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if name == "target" || name == "shared" || name == "node_modules" || (name.starts_with('.') && name != ".ci") {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if wanted(&path) {
                let Ok(text) = fs::read_to_string(&path) else { continue };
                found.push((path.strip_prefix(&root).unwrap().to_string_lossy().into_owned(), text));
            }
        }
    }
    found.sort();
    found
}

fn has_extension(extension: &'static str) -> impl Fn(&Path) -> bool {
    move |path| path.extension().is_some_and(|e| e == extension)
}

/// Unit tests in files of their own.
fn is_test_file(path: &str) -> bool {
    path.ends_with("tests.rs")
        || path.contains("/tests/")
        || path.ends_with("/testdata.rs")
        || path.contains("/testdata/")
        || path.ends_with("/layout_check.rs")
}

fn assert_none(violations: &[String]) {
    assert!(violations.is_empty(), "\n{}", violations.join("\n"));
}

// What a module of the library may import, `progress` aside, which everything may. No cycle is possible: a test below orders the table.
const LIBRARY: [(&str, &[&str]); 16] = [
    ("progress", &[]),
    ("geometry", &[]),
    ("radiometry", &["geometry"]),
    ("directions", &["geometry"]),
    ("images", &["radiometry"]),
    // Charts are numbers, their PNG an image.
    ("charts", &["images"]),
    ("textures", &[]),
    // Pages are numbers to both.
    ("gpu", &["textures"]),
    // Statistics and linear algebra over functions of direction: a channel is a number.
    // On the device, too.
    ("fitting", &["directions", "gpu"]),
    // Readers of foreign formats give meshes and patches, which `scenes` places; importers of captures are to follow in `capture`.
    ("formats", &["geometry", "directions", "radiometry", "images"]),
    ("scenes", &["formats", "geometry", "directions", "radiometry", "images"]),
    ("raytrace", &["scenes", "geometry", "directions", "radiometry", "images"]),
    ("capture", &["fitting", "formats", "raytrace", "scenes", "textures", "geometry", "directions", "radiometry", "images"]),
    ("representations", &["capture", "fitting", "raytrace", "scenes", "textures", "gpu", "geometry", "directions", "radiometry", "images"]),
    ("render", &["representations", "capture", "raytrace", "scenes", "textures", "gpu", "geometry", "directions", "radiometry", "images"]),
    (
        "evaluate",
        &[
            "render",
            "representations",
            "capture",
            "fitting",
            "raytrace",
            "scenes",
            "textures",
            "gpu",
            "geometry",
            "directions",
            "radiometry",
            "images",
            "charts",
        ],
    ),
];

/// Names after `crate::`, of code, not of comments; `use crate::{a, b::c}` counts both.
fn crate_imports(text: &str) -> BTreeSet<String> {
    let code: String = text.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n");
    let mut names = BTreeSet::new();
    for (at, _) in code.match_indices("crate::") {
        // `$crate::`, `my_crate::` and the like are not this crate.
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == '$') {
            continue;
        }
        let rest = &code[at + "crate::".len()..];
        let list = rest.strip_prefix('{').map(outermost_names);
        names.extend(list.unwrap_or_else(|| vec![leading_name(rest)]));
    }
    names.retain(|name| !name.is_empty());
    names
}

fn leading_name(text: &str) -> String {
    text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// Of "a::{b, c}, d}…": a and d.
fn outermost_names(list: &str) -> Vec<String> {
    let (mut names, mut depth, mut start) = (Vec::new(), 0, 0);
    for (at, c) in list.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth > 0 => depth -= 1,
            ',' | '}' if depth == 0 => {
                names.push(leading_name(&list[start..at]));
                start = at + 1;
                if c == '}' {
                    break;
                }
            }
            _ => {}
        }
    }
    names
}

fn forbidden_imports(path: &str, text: &str) -> Vec<String> {
    let module = path.trim_start_matches("server/lumisphere/src/").split(['/', '.']).next().unwrap_or_default();
    let Some((_, allowed)) = LIBRARY.iter().find(|(name, _)| *name == module) else {
        return if module == "lib" || module == "testdata" {
            vec![]
        } else {
            vec![format!("{path}: module {module} is not in the table of dependencies")]
        };
    };
    let is_module = |name: &str| LIBRARY.iter().any(|(module, _)| *module == name);
    let is_fine = |name: &String| !is_module(name) || name == module || name == "progress" || allowed.contains(&name.as_str());
    crate_imports(text).into_iter().filter(|name| !is_fine(name)).map(|name| format!("{path}: {module} may not import {name}")).collect()
}

#[test]
fn library_modules_import_only_what_lies_below_them() {
    let mut files = texts("server/lumisphere/src", has_extension("rs"));
    // Tests may look down from above: they render what a representation made.
    files.retain(|(path, _)| !is_test_file(path));
    assert!(files.len() > 20, "only {} files seen", files.len());
    assert_none(&files.iter().flat_map(|(path, text)| forbidden_imports(path, text)).collect::<Vec<_>>());
}

#[test]
fn an_upward_import_is_caught_however_it_is_written() {
    let path = "server/lumisphere/src/geometry/pose.rs";
    for bad in [
        "use crate::render::Frame;",
        "use crate::{geometry::Ray, render::Frame};",
        "let x = crate::scenes::Scene::new();",
        "use\n crate::{a::{b, c}, gpu};",
    ] {
        assert_eq!(forbidden_imports(path, bad).len(), 1, "{bad}");
    }
    for good in ["use crate::geometry::Ray;", "// use crate::render::Frame;", "use crate::progress::Progress;", "my_crate::render::f();"] {
        assert_eq!(forbidden_imports(path, good), Vec::<String>::new(), "{good}");
    }
    assert_eq!(forbidden_imports("server/lumisphere/src/brand_new/mod.rs", "").len(), 1);
}

#[test]
fn the_table_of_dependencies_has_no_cycle() {
    // The table is written in an order in which each module names only earlier ones.
    for (i, (module, allowed)) in LIBRARY.iter().enumerate() {
        for name in *allowed {
            assert!(LIBRARY[..i].iter().any(|(earlier, _)| earlier == name), "{module} names {name}, which does not come before it");
        }
    }
}

fn sibling_imports(path: &str, text: &str) -> Vec<String> {
    let Some(folder) =
        path.strip_prefix("server/lumisphere/src/representations/").and_then(|p| p.split_once('/')).map(|(folder, _)| folder)
    else {
        return vec![];
    };
    let others = fs::read_dir(repository().join("server/lumisphere/src/representations")).unwrap().map(|e| e.unwrap());
    // What they share (the G-buffer) is no representation: it has no form on disk.
    let others: Vec<String> =
        others.filter(|e| e.path().join("storage.rs").exists()).map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    let names = |other: &&String| {
        *other != folder && (text.contains(&format!("representations::{other}")) || text.contains(&format!("super::super::{other}")))
    };
    others.iter().filter(names).map(|other| format!("{path} names {other}")).collect()
}

#[test]
fn no_representation_imports_another() {
    let files = texts("server/lumisphere/src/representations", has_extension("rs"));
    assert_none(&files.iter().flat_map(|(path, text)| sibling_imports(path, text)).collect::<Vec<_>>());
    let bad = "use crate::representations::offset_surface_light_field::Settings;";
    assert_eq!(sibling_imports("server/lumisphere/src/representations/light_probes/mod.rs", bad).len(), 1, "the rule sees nothing");
}

/// Dependency names of every `[…dependencies]` table of a manifest, dev-dependencies aside.
fn dependencies(manifest: &str) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    let mut inside = false;
    for line in manifest.lines().map(str::trim) {
        if let Some(table) = line.strip_prefix('[') {
            inside = table.ends_with("dependencies]") && !table.contains("dev-dependencies");
        } else if inside && !line.starts_with('#') {
            names.extend(line.split(['=', '.', ' ']).next().filter(|n| !n.is_empty()).map(String::from));
        }
    }
    names
}

fn forbidden_dependencies(manifest: &str, forbidden: &[&str]) -> Vec<String> {
    dependencies(manifest).into_iter().filter(|name| forbidden.iter().any(|f| name == f || name.starts_with(&format!("{f}-")))).collect()
}

#[test]
fn the_library_knows_neither_wire_nor_command_line() {
    const FORBIDDEN: [&str; 9] = ["tokio", "tonic", "prost", "clap", "axum", "hyper", "anyhow", "tracing", "lumisphere-proto"];
    let manifest = fs::read_to_string(repository().join("server/lumisphere/Cargo.toml")).unwrap();
    assert!(dependencies(&manifest).contains("glam"), "the manifest is not understood");
    assert_none(&forbidden_dependencies(&manifest, &FORBIDDEN));
    let bad = "[dependencies]\ntonic-health.workspace = true\n[dev-dependencies]\ntokio = \"1\"\n";
    assert_eq!(forbidden_dependencies(bad, &FORBIDDEN), ["tonic-health"]);
}

#[test]
fn only_the_client_the_service_and_the_tests_know_the_wire() {
    let expected: BTreeMap<&str, bool> =
        [("client", true), ("server/service", true), ("tests", true), ("server/lumisphere", false), ("proto", false)].into();
    for (package, may_know) in expected {
        let manifest = fs::read_to_string(repository().join(package).join("Cargo.toml")).unwrap();
        assert_eq!(manifest.contains("lumisphere-proto.workspace"), may_know, "{package}");
    }
}

fn names_the_wire(path: &str, text: &str) -> bool {
    let is_wire = path == "server/service/src/wire.rs" || path.starts_with("server/service/src/wire/");
    !is_wire && text.lines().any(|line| line.split("//").next().unwrap_or_default().contains("lumisphere_proto"))
}

#[test]
fn within_the_service_only_wire_names_the_proto_crate() {
    let files = texts("server/service/src", has_extension("rs"));
    assert_none(&files.iter().filter(|(p, t)| names_the_wire(p, t)).map(|(p, _)| p.clone()).collect::<Vec<_>>());
    assert!(names_the_wire("server/service/src/jobs.rs", "use lumisphere_proto::v1alpha1::Job;"));
    assert!(!names_the_wire("server/service/src/wire/jobs.rs", "use lumisphere_proto::v1alpha1::Job;"));
}

fn prints_or_reads_the_environment(text: &str) -> Vec<String> {
    const FORBIDDEN: [&str; 7] = ["println!(", "print!(", "eprintln!(", "eprint!(", "env::var", "env::args", "process::exit"];
    // What is compiled for tests alone comes last in a file and may; a declaration (`mod tests;`) is not the beginning of it.
    let is_body = |(_, after): &(usize, &str)| after.lines().nth(1).is_some_and(|line| line.contains('{') && !line.starts_with("use "));
    let tests_begin = text.match_indices("#[cfg(test)]\n").map(|(at, _)| (at, &text[at..])).find(is_body).map_or(text.len(), |(at, _)| at);
    let product = &text[..tests_begin];
    let code = product.lines().map(|line| line.split("//").next().unwrap_or_default());
    code.filter(|line| FORBIDDEN.iter().any(|f| line.contains(f))).map(|line| line.trim().to_string()).collect()
}

#[test]
fn the_library_does_not_print_or_read_the_environment() {
    let files = texts("server/lumisphere/src", has_extension("rs"));
    let product = files.iter().filter(|(path, _)| !is_test_file(path));
    let said = |(path, text): &(String, String)| {
        prints_or_reads_the_environment(text).into_iter().map(move |l| format!("{path}: {l}")).collect::<Vec<_>>()
    };
    // Rewriting goldens is for tests: the variable is read where the tests call.
    assert_none(&product.filter(|(path, _)| !path.ends_with("images/golden.rs")).flat_map(said).collect::<Vec<_>>());
    let bad = "#[cfg(test)]\nmod tests;\nfn f() { println!(\"x\"); }\n// println!(\n#[cfg(test)]\nfn g() {\n println!(\"y\"); }\n";
    assert_eq!(prints_or_reads_the_environment(bad), ["fn f() { println!(\"x\"); }"]);
}

fn machine_paths(text: &str) -> Vec<String> {
    // Written in pieces, so that this file does not break its own rule.
    let marks = [concat!("/ho", "me/"), concat!("/ro", "ot/"), concat!("/Us", "ers/"), concat!("/wo", "rk/"), concat!("C:", "\\Us", "ers")];
    let is_path = |line: &str, mark: &str| {
        let before = line.find(mark).map(|at| line[..at].chars().next_back());
        before.is_some_and(|c| c.is_none_or(|c| !c.is_alphanumeric() && c != '.' && c != '_' && c != '-' && c != '~' && c != '}'))
    };
    text.lines().filter(|line| marks.iter().any(|mark| is_path(line, mark))).map(|line| line.trim().to_string()).collect()
}

#[test]
fn no_file_names_a_folder_of_one_machine() {
    let files = texts("", |path| {
        path.extension()
            .is_none_or(|e| ["rs", "toml", "md", "proto", "wgsl", "json", "txt", "yml", "yaml", "service"].iter().any(|x| e == *x))
    });
    assert!(files.len() > 60, "only {} files seen", files.len());
    let found =
        |(path, text): &(String, String)| machine_paths(text).into_iter().map(move |line| format!("{path}: {line}")).collect::<Vec<_>>();
    assert_none(&files.iter().flat_map(found).collect::<Vec<_>>());
    assert_eq!(machine_paths(concat!("let p = \"/ho", "me/ann/x\";\nlet q = \"a/work/b\";")).len(), 1);
}

/// A shader's twin has its name, or is named in its first line ("Twin of trace.rs"), beside it or from the library's root.
fn shaders_without_twin(files: &[(String, String)]) -> Vec<String> {
    let exists = |path: &str| files.iter().any(|(other, _)| other == path);
    let has_twin = |(path, text): &(String, String)| {
        let folder = path.rsplit_once('/').map_or("", |(folder, _)| folder);
        let head = text.lines().next().unwrap_or_default();
        let named = head
            .split_once("Twin of ")
            .map(|(_, rest)| rest.split(|c: char| c.is_whitespace() || c == ';' || c == ',').next().unwrap_or_default());
        let named = named.map(|name| name.trim_end_matches('.'));
        exists(&path.replace(".wgsl", ".rs"))
            || named.is_some_and(|name| exists(&format!("{folder}/{name}")) || exists(&format!("server/lumisphere/src/{name}")))
    };
    files.iter().filter(|f| f.0.ends_with(".wgsl") && !has_twin(f)).map(|(path, _)| path.clone()).collect()
}

#[test]
fn every_shader_names_its_rust_twin_or_lies_beside_it() {
    let files = texts("server/lumisphere/src", |p| has_extension("wgsl")(p) || has_extension("rs")(p));
    assert_none(&shaders_without_twin(&files));
    let file = |path: &str, text: &str| (path.to_string(), text.to_string());
    let lonely = [
        file("a/kernel.wgsl", "// Twin of gone.rs."),
        file("b/map.wgsl", ""),
        file("b/map.rs", ""),
        file("b/draw.wgsl", "// Draws. Twin of map.rs."),
    ];
    assert_eq!(shaders_without_twin(&lonely), ["a/kernel.wgsl"]);
}

/// The part of a file that is tests.
fn test_part<'a>(path: &str, text: &'a str) -> &'a str {
    if is_test_file(path) || path.starts_with("tests/") {
        return text;
    }
    text.split_once("mod tests {").map_or("", |(_, tests)| tests)
}

// Marks are written in pieces, so that this file does not break its own rule.
fn untrustworthy(path: &str, text: &str) -> Vec<String> {
    const ANYWHERE: [&str; 3] = [concat!("#[ig", "nore"), concat!("to", "do!("), concat!("unimple", "mented!(")];
    // (The runtime's own sleep is fine under a paused clock.)
    const IN_TESTS: [&str; 1] = [concat!("thread::sl", "eep")];
    let lines = |text: &str, marks: &[&str]| {
        let marked = text.lines().filter(|line| marks.iter().any(|mark| line.contains(mark)));
        marked.map(|line| format!("{path}: {}", line.trim())).collect::<Vec<_>>()
    };
    [lines(text, &ANYWHERE), lines(test_part(path, text), &IN_TESTS)].concat()
}

#[test]
fn no_test_is_skipped_or_sleeps_and_no_work_is_left_out() {
    let files = texts("", has_extension("rs"));
    assert_none(&files.iter().flat_map(|(path, text)| untrustworthy(path, text)).collect::<Vec<_>>());
    assert_eq!(untrustworthy("a.rs", concat!("#[ig", "nore]\nfn f() {}")).len(), 1);
    let sleeps = concat!("fn f() { thread::sl", "eep(d) }\nmod tests {\n thread::sl", "eep(d)\n}");
    assert_eq!(untrustworthy("a.rs", sleeps).len(), 1);
    assert_eq!(untrustworthy("a/tests.rs", sleeps).len(), 2);
}

/// Keys of a TOML text without tables.
fn toml_keys(text: &str) -> BTreeSet<String> {
    let key = |line: &str| line.split_once(" = ").map(|(key, _)| key.trim().to_string());
    text.lines().filter(|line| !line.starts_with('#')).filter_map(key).collect()
}

#[test]
fn the_example_configuration_has_every_key() {
    let example = fs::read_to_string(repository().join("deploy/server.toml")).unwrap();
    let config = fs::read_to_string(repository().join("server/service/src/config.rs")).unwrap();
    let keys: BTreeSet<String> =
        config.match_indices(" key: \"").map(|(at, mark)| config[at + mark.len()..].split('"').next().unwrap().to_string()).collect();
    assert!(keys.len() > 10, "config.rs is not understood: {keys:?}");
    assert_eq!(toml_keys(&example), keys);
    assert_eq!(toml_keys("# a = 1\nb = 2\n"), BTreeSet::from(["b".to_string()]));
}
