//! A triangle as glTF text, and ways to break it.

use super::uris::base64;
use super::*;

// A triangle, as text with everything inside it; `{…}` may be replaced by the tests.
fn triangle() -> String {
    let floats: Vec<u8> = [0f32, 0., 0., 1., 0., 0., 0., 1., 0.].iter().flat_map(|f| f.to_le_bytes()).collect();
    let encoded = encode(&floats);
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
        "nodes":[{{"name":"n","mesh":0,"translation":[1,2,3],"children":[1]}},{{"camera":0,"name":"eye"}}],
        "cameras":[{{"type":"perspective","perspective":{{"yfov":1.0,"znear":0.1,"aspectRatio":1.5}}}}],
        "materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[0.2,0.4,0.6,1]}},"emissiveFactor":[1,0.5,0],
            "extensions":{{"KHR_materials_emissive_strength":{{"emissiveStrength":4}}}},"alphaMode":"MASK"}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"material":0}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}}],
        "buffers":[{{"byteLength":36,"uri":"data:application/octet-stream;base64,{encoded}"}}]}}"#
    )
}

fn encode(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |g: &[u8]| {
        let word = g.iter().enumerate().fold(0u32, |w, (i, b)| w | (*b as u32) << (16 - 8 * i));
        (0..=g.len()).map(|i| DIGITS[(word >> (18 - 6 * i)) as usize & 63] as char).collect::<String>()
    };
    bytes.chunks(3).map(group).collect()
}

fn read_text(text: &str) -> Result<GltfModel, GltfError<String>> {
    read(text.as_bytes(), &mut |uri| Err(format!("asked for {uri}")))
}

fn message(text: &str) -> String {
    match read_text(text) {
        Err(GltfError::Format(e)) => e.to_string(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn geometry_colour_emission_and_camera_arrive() {
    let model = read_text(&triangle()).unwrap();
    assert_eq!(model.objects[0].mesh.positions[1], Vec3::new(2.0, 2.0, 3.0));
    assert_eq!(model.objects[0].mesh.normals[0], Vec3::Z);
    let material = &model.materials[model.objects[0].material];
    assert_eq!((material.base_color, material.emission), (Vec3::new(0.2, 0.4, 0.6), Vec3::new(4.0, 2.0, 0.0)));
    assert_eq!((model.cameras[0].name.as_str(), model.cameras[0].aspect), ("eye", 1.5));
    assert!((model.cameras[0].vfov_deg - 57.29578).abs() < 1e-4);
    assert_eq!(model.cameras[0].world_from_camera.w_axis.truncate(), Vec3::new(1.0, 2.0, 3.0));
    assert!(model.notes[0].contains("alpha is not applied"));
}

#[test]
fn a_mirroring_node_keeps_the_front() {
    let model = read_text(&triangle().replace(r#""translation":[1,2,3]"#, r#""scale":[-1,1,1]"#)).unwrap();
    assert!(model.objects[0].mesh.positions.contains(&Vec3::NEG_X));
    assert!(model.objects[0].mesh.area_vector(0).z > 0.0, "it faced +z, which the mirror leaves alone");
}

#[test]
fn what_is_broken_is_named() {
    assert!(message(&triangle().replace(r#""count":3"#, r#""count":4"#)).contains("accessor 0 reaches beyond its buffer view"));
    assert!(message(&triangle().replace(r#""count":3"#, r#""count":0"#)).contains("accessor 0 is empty"));
    assert!(message(&triangle().replace(r#""type":"VEC3""#, r#""type":"VEC2""#)).contains("accessor 0 has 2 components"));
    assert!(message(&triangle().replace(r#""byteLength":36,"uri"#, r#""byteLength":37,"uri"#)).contains("36 bytes, 37 announced"));
    assert!(message(&triangle().replace(r#""byteLength":36}"#, r#""byteLength":40}"#)).contains("lies outside its buffer"));
    assert!(message(&triangle().replace(r#""children":[1]"#, r#""children":[0]"#)).contains("own ancestor"));
    assert!(message(&triangle().replace(r#""translation":[1,2,3]"#, r#""scale":[0,1,1]"#)).contains("no volume"));
    assert!(message(&triangle().replace("AAAAAA", "AA*AAA")).contains("base64"));
    assert!(message("{}").contains("not a glTF"));
    assert!(message(&triangle().replace(r#""nodes":[0]"#, r#""nodes":[]"#)).contains("no triangle"));
    assert!(
        matches!(read_text(&triangle().replace("data:application/octet-stream;base64,", "a%20b.bin?")), Err(GltfError::File(f)) if f.starts_with("asked for a b.bin"))
    );
}

#[test]
fn a_binary_file_cut_off_anywhere_is_an_error() {
    let json = triangle();
    let mut glb = b"glTF\x02\0\0\0".to_vec();
    let padded = json.len().div_ceil(4) * 4;
    glb.extend((20 + padded as u32).to_le_bytes());
    glb.extend((padded as u32).to_le_bytes());
    glb.extend(b"JSON");
    glb.extend(json.bytes().chain(std::iter::repeat(b' ')).take(padded));
    assert!(read(&glb, &mut |_| Err(())).is_ok());
    for length in 0..glb.len() {
        assert!(read(&glb[..length], &mut |_| Err(())).is_err(), "{length} bytes");
    }
    glb[8..12].copy_from_slice(&4u32.to_le_bytes());
    assert!(read(&glb, &mut |_| Err(())).is_err(), "a length below its own header");
}

#[test]
fn base64_decodes_every_remainder() {
    for bytes in [&b""[..], b"a", b"ab", b"abc", b"abcd"] {
        assert_eq!(base64(&encode(bytes)).unwrap(), bytes);
    }
    assert_eq!(base64("YQ==").unwrap(), b"a");
    assert_eq!(base64("A"), None);
}
