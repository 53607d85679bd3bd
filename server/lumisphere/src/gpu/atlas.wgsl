// Texels of images in the atlas: atlas.rs has the words' layout. Expects `shading.face_size` from the kernel that includes it.

// How many textures hold slots: the others are never read.
override ATLAS_TEXTURES: u32 = 4u;

const NOT_RESIDENT: u32 = 0xffffffffu;

@group(2) @binding(0) var atlas_0: texture_2d_array<f32>;
@group(2) @binding(1) var atlas_1: texture_2d_array<f32>;
@group(2) @binding(2) var atlas_2: texture_2d_array<f32>;
@group(2) @binding(3) var atlas_3: texture_2d_array<f32>;

// Texel (column, row) of level `level` of the image that stands `origin` texels into the slot that a word names; zero where it names none.
fn slot_texel(word: u32, origin: vec2<u32>, column: u32, row: u32, level: u32) -> vec4<f32> {
    if word == NOT_RESIDENT {
        return vec4(0.0);
    }
    let corner = vec2(word & 0xffu, (word >> 8u) & 0xffu) * shading.face_size + origin;
    let at = (corner >> vec2(level)) + vec2(column, row);
    let layer = (word >> 16u) & 0x1fffu;
    if ATLAS_TEXTURES > 1u {
        let texture = (word >> 29u) & 3u;
        if texture == 1u { return textureLoad(atlas_1, at, layer, level); }
        if texture == 2u { return textureLoad(atlas_2, at, layer, level); }
        if texture == 3u { return textureLoad(atlas_3, at, layer, level); }
    }
    return textureLoad(atlas_0, at, layer, level);
}
