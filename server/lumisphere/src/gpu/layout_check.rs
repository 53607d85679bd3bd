//! Tests' view of WGSL: every source is valid, and its structs lie in memory as their Rust twins do.

use std::path::Path;

use naga::valid::{Capabilities, ValidationFlags, Validator};

/// Parses and validates a whole source; panics with the parser's own message.
pub(crate) fn validated(source: &str) -> naga::Module {
    let module = naga::front::wgsl::parse_str(source).unwrap_or_else(|e| panic!("{}", e.emit_to_string(source)));
    let outcome =
        Validator::new(ValidationFlags::all(), Capabilities::default() | Capabilities::SHADER_FLOAT16_IN_FLOAT32).validate(&module);
    outcome.unwrap_or_else(|e| panic!("{}", e.emit_to_string(source)));
    module
}

/// A struct's members (name, offset) and size as WGSL lays it out.
pub(crate) fn wgsl_layout(source: &str, name: &str) -> (Vec<(String, usize)>, usize) {
    let module = validated(source);
    let found = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name));
    let Some((_, naga::Type { inner: naga::TypeInner::Struct { members, span }, .. })) = found else {
        panic!("no struct {name}");
    };
    let members = members.iter().map(|m| (m.name.clone().unwrap_or_default(), m.offset as usize)).collect();
    (members, *span as usize)
}

/// Compares the WGSL struct of that name with a Rust type, field by field.
macro_rules! assert_same_layout {
    ($source:expr, $name:literal, $type:ty { $($field:ident),* $(,)? }) => {
        let rust = vec![$((stringify!($field).to_string(), std::mem::offset_of!($type, $field))),*];
        assert_eq!($crate::gpu::layout_check::wgsl_layout($source, $name), (rust, size_of::<$type>()), $name);
    };
}
pub(crate) use assert_same_layout;

fn wgsl_files(folder: &Path, found: &mut Vec<(String, String)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            wgsl_files(&path, found);
        } else if path.extension().is_some_and(|e| e == "wgsl") {
            found.push((path.display().to_string(), std::fs::read_to_string(&path).unwrap()));
        }
    }
}

#[test]
fn every_wgsl_file_is_part_of_a_valid_source() {
    // The BRDFs are no source of their own: kernels include them, and so does their test.
    let brdfs = crate::radiometry::brdf::gpu_equals_cpu_tests::SOURCE;
    let sources = [crate::representations::wgsl_sources(), vec![brdfs.into(), crate::fitting::LOBE_KERNEL_SOURCE.into()]].concat();
    for source in &sources {
        validated(source);
    }
    let mut files = Vec::new();
    wgsl_files(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    assert!(files.len() >= 6);
    for (path, text) in files {
        assert!(sources.iter().any(|s| s.contains(&text)), "{path} is in no source that is validated");
    }
}

#[test]
#[should_panic(expected = "left")]
fn a_field_out_of_place_is_noticed() {
    #[repr(C)]
    struct Shifted {
        position: [f32; 3],
        near: f32,
        padding: f32,
        right: [f32; 3],
    }
    let source = "struct Shifted { position: vec3<f32>, near: f32, right: vec3<f32>, padding: f32 }";
    assert_same_layout!(source, "Shifted", Shifted { position, near, right, padding });
}
