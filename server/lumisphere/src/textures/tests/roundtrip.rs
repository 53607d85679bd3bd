//! What is written is read back.

use half::f16;
use proptest::prelude::*;

use super::*;

/// Encodes as a stored page and decodes it again.
fn through_store(shape: &PageShape, texels: &[f32]) -> (Page, Appended) {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "t").unwrap();
    let appended = staging.append_page(PageId(0), shape, texels).unwrap();
    (staging.publish(publication()).unwrap().read_page(PageId(0)).unwrap(), appended)
}

#[test]
fn a_published_version_is_read_back_bit_for_bit_after_reopening() {
    let root = tempfile::tempdir().unwrap();
    let published = publish(&open(root.path()).0, 5);
    assert_whole(&published, 5);
    drop(published);
    let (store, report) = open(root.path());
    assert_eq!(report.index, IndexOutcome::Intact);
    assert!(report.damaged.is_empty() && report.swept.is_empty() && report.resumable.is_empty(), "{report:?}");
    let version = store.open_version("d", None).unwrap();
    assert_whole(&version, 5);
    assert_eq!(version.manifest().parameters, publication().parameters);
    assert_eq!(store.versions("d").unwrap(), [1]);
}

fn codecs() -> impl Strategy<Value = Codec> {
    prop::sample::select(Codec::ALL.to_vec())
}

/// Packs a page and unpacks some of its rows.
fn through_codec(codec: Codec, shape: &PageShape, texels: &[f32], rows: std::ops::Range<u32>) -> Page {
    let encoded = encode_as(codec, shape, texels).unwrap();
    // Only the blocks that the codec says it needs.
    let needed = codec.blocks_for(&rows);
    let packed = |index: u32| {
        let block = encoded.blocks[index as usize];
        needed.contains(&index).then(|| &encoded.payload[block.offset as usize..(block.offset + block.length) as usize])
    };
    let source = codec::Source { codec, layout: codec::Layout::of(codec), shape: *shape, table: &encoded.blocks, packed: &packed };
    codec::decode(&source, rows).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]

    /// From smooth to random numbers, from any row to any other.
    #[test]
    fn any_rows_are_unpacked_from_the_blocks_a_codec_asks_for(
        codec in codecs(), width in 1u32..20, height in 1u32..70, channels in 1u32..=4, roughness in 0u32..32, from in 0u32..70, count in 1u32..70,
    ) {
        let shape = shape(width, height, channels, PixelFormat::F32);
        let rough = |i: usize| ((i as u32).wrapping_mul(0x9E37_79B9) >> (31 - roughness)) as f32;
        let texels: Vec<f32> = (0..shape.values()).map(|i| rough(i) + i as f32).collect();
        let rows = from % height..(from % height + count).min(height);
        let page = through_codec(codec, &shape, &texels, rows.clone());
        let row = shape.row_values();
        prop_assert_eq!(page.to_f32(), &texels[rows.start as usize * row..rows.end as usize * row]);
        prop_assert!(codec.unpacked_rows(&shape, &rows) as usize >= rows.len());
    }

    /// Any bits, NaN payloads included, of any small shape.
    #[test]
    fn f32_pages_keep_every_bit(codec in codecs(), width in 1u32..40, height in 1u32..40, channels in 1u32..=4, seed in any::<u32>()) {
        let shape = shape(width, height, channels, PixelFormat::F32);
        let bits = |i: usize| (i as u32 ^ seed).wrapping_mul(0x9E37_79B9).rotate_left(i as u32 % 32);
        let texels: Vec<f32> = (0..shape.values()).map(|i| f32::from_bits(bits(i))).collect();
        let page = through_codec(codec, &shape, &texels, 0..height);
        prop_assert!(page.to_f32().iter().zip(&texels).all(|(a, b)| a.to_bits() == b.to_bits()));
    }

    /// Delta and planes lose nothing that rounding to f16 has kept.
    #[test]
    fn f16_pages_keep_the_nearest_f16(codec in codecs(), width in 1u32..40, height in 1u32..40, channels in 1u32..=4, seed in any::<u32>()) {
        let shape = shape(width, height, channels, PixelFormat::F16);
        // Any sign and any exponent but that of NaN and infinity.
        let bits = |i: usize| ((i as u32 ^ seed).wrapping_mul(0x9E37_79B9) >> 16) as u16 & 0xBFFF;
        let texels: Vec<f32> = (0..shape.values()).map(|i| f16::from_bits(bits(i)).to_f32()).collect();
        let page = through_codec(codec, &shape, &texels, 0..height);
        prop_assert_eq!(page.to_f32(), texels);
    }
}

/// The error of f16 storage: 2⁻¹¹ relative for numbers from 2⁻¹⁴ to 65504, half of 2⁻²⁴ absolute below. The largest error found is
/// within 1 % of the bound, so the sweep does meet the worst cases.
#[test]
fn f16_pages_err_by_at_most_two_to_the_minus_eleven() {
    let shape = shape(256, 256, 1, PixelFormat::F16);
    // Log-spaced from 1e-8 to 6e4 and of both signs.
    let value = |i: usize| 10f32.powf(-8.0 + 12.778 * i as f32 / 65535.0) * if i.is_multiple_of(2) { 1.0 } else { -1.0 };
    let texels: Vec<f32> = (0..shape.values()).map(value).collect();
    let (page, appended) = through_store(&shape, &texels);
    assert_eq!(appended.clamped, 0);
    let normal = 2f32.powi(-14);
    let (mut relative, mut absolute) = (0f32, 0f32);
    for (&read, &written) in page.to_f32().iter().zip(&texels) {
        if written.abs() >= normal {
            relative = relative.max((read - written).abs() / written.abs());
        } else {
            absolute = absolute.max((read - written).abs());
        }
    }
    assert!(relative <= 2f32.powi(-11), "relative error {relative:e}");
    assert!(relative > 0.99 * 2f32.powi(-11), "the sweep misses the worst case: {relative:e}");
    assert!(absolute <= 2f32.powi(-25), "absolute error {absolute:e}");
}

#[test]
fn f16_clamps_what_it_cannot_hold_and_keeps_infinity() {
    let shape = shape(6, 1, 1, PixelFormat::F16);
    let (page, appended) = through_store(&shape, &[65504.0, 65519.0, 1e30, -70000.0, f32::INFINITY, f32::NEG_INFINITY]);
    assert_eq!(page.to_f32(), [65504.0, 65504.0, 65504.0, -65504.0, f32::INFINITY, f32::NEG_INFINITY]);
    assert_eq!(appended.clamped, 3);
}

#[test]
fn rows_are_read_without_the_rest() {
    let root = tempfile::tempdir().unwrap();
    let version = publish(&open(root.path()).0, 2);
    let all = texels(&small(), 1);
    let row = small().row_values();
    for rows in [0..1, 0..16, 15..17, 16..32, 33..40, 0..40, 39..40] {
        let page = version.read_rows(PageId(1), rows.clone()).unwrap();
        assert_eq!(page.shape().height, rows.len() as u32);
        assert_eq!(page.to_f32(), all[rows.start as usize * row..rows.end as usize * row], "rows {rows:?}");
    }
    assert!(matches!(version.read_rows(PageId(1), 39..41), Err(StoreError::NotFound { .. })));
    assert!(matches!(version.read_rows(PageId(1), 3..3), Err(StoreError::NotFound { .. })));
    assert!(matches!(version.read_page(PageId(2)), Err(StoreError::NotFound { .. })));
}

#[test]
fn a_texel_is_where_it_was_written() {
    for pixel in [PixelFormat::F32, PixelFormat::F16] {
        let shape = shape(5, 18, 3, pixel);
        // Small integers, exact in both formats.
        let texels: Vec<f32> = (0..shape.values()).map(|i| i as f32).collect();
        let (page, _) = through_store(&shape, &texels);
        assert_eq!(page.texel(4, 17), [267.0, 268.0, 269.0, 0.0]);
        assert_eq!(page.texel(0, 1), [15.0, 16.0, 17.0, 0.0]);
        let mut row = Vec::new();
        page.extend_row(17, &mut row);
        assert_eq!(row, texels[17 * 15..]);
        assert_eq!(page.bytes().len(), shape.decoded_bytes());
    }
}

#[test]
fn equal_pages_give_equal_segments_whoever_encoded_them() {
    let hashes: Vec<_> = (0..2)
        .map(|_| {
            let root = tempfile::tempdir().unwrap();
            let version = publish(&open(root.path()).0, 3);
            version.manifest().clone()
        })
        .collect();
    assert_eq!(hashes[0], hashes[1]);
}

#[test]
fn shapes_that_cannot_be_stored_are_refused() {
    let refused = |width, height, channels, count| {
        let result = encode(&shape(width, height, channels, PixelFormat::F32), &vec![0.0; count]);
        assert!(matches!(result, Err(StoreError::InvalidPage { .. })), "{width}×{height}×{channels}");
    };
    refused(0, 4, 1, 0);
    refused(4, 0, 1, 0);
    refused(4, 4, 0, 0);
    refused(4, 4, 5, 80);
    refused(4, 4, 3, 47);
    refused(u32::MAX, u32::MAX, 4, 0);
}

/// Records as they were written when all planes of a block were in one frame.
#[test]
fn records_of_the_first_version_are_read() {
    let records = [
        (
            shape(5, 18, 3, PixelFormat::F32),
            "4c535047010001010000000005000000120000000300000002000000bc000000610f1651ea4ae88d00000000720000001b259848e7ef900a720000\
             004a0000006e706f1cf9b1272328b52ffd60c0024503000403000000ffff80007f4000807f80400000ff800000403f00ff4000007e0101017d007f\
             000001007d027e7e017e0102027e1400011078710a421827a05aa8506520830a6b2027a0645428f2dc104021003a81025a01010b06284032061d08\
             814e40815410d8754428b52ffd20780d020032c40a10d0a5030000006b49b9005a2c40145ba6f3b024423d0f4912d64b84a4ece39d5f5930def73a\
             83cd3ccf070800416d784988d9a0a60320a0bbf742d800e000000000",
        ),
        (
            shape(3, 17, 4, PixelFormat::F16),
            "4c5350470100010200000000030000001100000004000000020000006a0000001c9d1888c07451a80000000049000000694664d50f9fb29e490000\
             002100000016d832b552ae868628b52ffd608000fd010014020000ff00ff00ffffff0000780f7a0714056f030b681209700c07030b7473787a070b\
             000053139519a0814a91a3ca7302030003a33207b4a8d473a92c4728b52ffd2018c1000000ff0000ff0000ff0000ffff747378780f127a090c7c07\
             73000000000000",
        ),
    ];
    for (shape, hex) in records {
        let record: Vec<u8> = (0..hex.len() / 2).map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).unwrap()).collect();
        let checksum = u64::from_le_bytes(record[32..40].try_into().unwrap());
        let (page, header) = segment::decode_record(&record, PageId(0), checksum).map_err(|bad| bad.reason).unwrap();
        assert_eq!((page.shape(), header.layout), (shape, codec::Layout::Together));
        let written: Vec<f32> = (0..shape.values()).map(|i| 0.25 * (i % 7) as f32).collect();
        assert_eq!(page.to_f32(), written);
    }
}

/// Channels that change together are kept as differences; others are not made worse by it.
#[test]
fn blocks_take_the_relation_of_their_channels_that_is_smaller() {
    let shape = shape(64, 32, 3, PixelFormat::F16);
    let noise = |i: usize| ((i as u32).wrapping_mul(0x9E37_79B9) >> 16) as f32 / 65536.0;
    // Grey in the upper block; in the lower one only the second channel changes.
    let texel = |i: usize| if i < 64 * 16 { [0.5 + 0.5 * noise(i); 3] } else { [1.0, 0.5 + 0.5 * noise(i), 1.0] };
    let texels: Vec<f32> = (0..64 * 32).flat_map(texel).collect();
    let halves: Vec<f32> = texels.iter().map(|v| f16::from_f32(*v).to_f32()).collect();
    for codec in [Codec::BitsChunk, Codec::ZstdChunk] {
        let encoded = encode_as(codec, &shape, &texels).unwrap();
        let relations: Vec<u8> = encoded.blocks.iter().map(|block| encoded.payload[block.offset as usize]).collect();
        assert_eq!(relations, [1, 0], "{codec}");
        assert_eq!(through_codec(codec, &shape, &texels, 0..32).to_f32(), halves, "{codec}");
        // The channels that say nothing new take next to no bytes: one noisy plane of 64 · 16 bytes and a part of the other a block.
        assert!(encoded.blocks.iter().all(|block| block.length < 2 * 64 * 16), "{codec}: {:?}", encoded.blocks);
    }
}
