//! Changed, cut and missing bytes: named where they matter, harmless elsewhere.

use std::fs;
use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use xxhash_rust::xxh3::xxh3_64;

use super::*;

/// The only file in a folder of the store.
fn only_file(root: &Path, folder: &str) -> PathBuf {
    let mut files: Vec<_> = fs::read_dir(root.join(folder)).unwrap().map(|e| e.unwrap().path()).collect();
    assert_eq!(files.len(), 1, "{files:?}");
    files.remove(0)
}

fn flip(path: &Path, at: usize) {
    let mut bytes = fs::read(path).unwrap();
    bytes[at] ^= 0x41;
    fs::write(path, bytes).unwrap();
}

fn written(rows: std::ops::Range<u32>, page: u32) -> Vec<f32> {
    let row = small().row_values();
    texels(&small(), page)[rows.start as usize * row..rows.end as usize * row].to_vec()
}

/// Reads pages block by block; the blocks that could not be read. All others have to be right.
fn unreadable_blocks(version: &DatasetVersion, pages: u32) -> Vec<(u32, u32)> {
    let mut unreadable = Vec::new();
    for page in 0..pages {
        for (block, rows) in [0..16, 16..32, 32..40].into_iter().enumerate() {
            match version.read_rows(PageId(page), rows.clone()) {
                Ok(read) => assert_eq!(read.to_f32(), written(rows, page)),
                Err(StoreError::DamagedPage { page: named, rows: named_rows, .. }) => {
                    assert_eq!(named, PageId(page));
                    assert!(named_rows == rows || named_rows == (0..40), "{named_rows:?}");
                    unreadable.push((page, block as u32));
                }
                Err(other) => panic!("{other}"),
            }
        }
    }
    unreadable
}

#[test]
fn a_flipped_byte_in_a_block_costs_that_block_only() {
    let root = tempfile::tempdir().unwrap();
    let (store, _) = open(root.path());
    let version = publish(&store, 3);
    // Page 1's record starts where page 0's ends; its second block lies somewhere behind its header and first block.
    let encoded = encode(&small(), &texels(&small(), 1)).unwrap();
    let record = encode(&small(), &texels(&small(), 0)).unwrap().stored_bytes() as usize;
    let second = record + 40 + 3 * 16 + encoded.blocks[1].offset as usize + 5;
    flip(&only_file(root.path(), "segments"), second);
    let error = version.read_page(PageId(1)).unwrap_err();
    let StoreError::DamagedPage { page, rows, reason, .. } = &error else { panic!("{error}") };
    assert_eq!((*page, rows.clone(), *reason), (PageId(1), 16..32, "checksum mismatch"));
    assert!(error.to_string().starts_with("damaged page 1, rows 16 to 32: checksum mismatch"), "{error}");
    assert_eq!(unreadable_blocks(&version, 3), [(1, 1)]);
    // The rest of the cache's world goes on too.
    let cache = Cache::new(CacheOptions::decoded(1 << 20));
    assert!(cache.page(&version, PageId(1)).is_err());
    assert_eq!(cache.page(&version, PageId(2)).unwrap().to_f32(), texels(&small(), 2));
}

/// Checksums do not tell who wrote a block: one that says something else than texels is an error, whatever it says.
#[test]
fn blocks_that_lie_under_a_right_checksum_are_refused_or_give_some_texels_and_never_panic() {
    let mut rng = Pcg32::seed_from_u64(5);
    for (codec, pixel) in Codec::ALL.into_iter().flat_map(|codec| [(codec, PixelFormat::F32), (codec, PixelFormat::F16)]) {
        let shape = PageShape { pixel, ..small() };
        let encoded = encode_as(codec, &shape, &texels(&shape, 0)).unwrap();
        let mut refused = 0;
        for step in 0..400 {
            let mut blocks: Vec<Vec<u8>> =
                encoded.blocks.iter().map(|b| encoded.payload[b.offset as usize..][..b.length as usize].to_vec()).collect();
            let block = &mut blocks[step % 3];
            match step / 3 % 3 {
                0 => block.truncate(rng.random_range(0..block.len())),
                1 => block.push(rng.random_range(0..=255)),
                // Most of what says how to unpack lies at the start.
                _ => block[rng.random_range(0..40)] ^= 1 << rng.random_range(0..8u32),
            }
            let entry = |bytes: &Vec<u8>| codec::Block { offset: 0, length: bytes.len() as u32, checksum: xxh3_64(bytes) };
            let table: Vec<_> = blocks.iter().map(entry).collect();
            let packed = |index: u32| Some(&blocks[index as usize][..]);
            let source = codec::Source { codec, layout: codec::Layout::of(codec), shape, table: &table, packed: &packed };
            match codec::decode(&source, 0..40) {
                Ok(page) => assert_eq!(page.shape(), shape),
                Err(_) => refused += 1,
            }
        }
        assert!(refused >= 100, "{codec} {pixel:?}: {refused} of 400 refused");
    }
}

// A dataset of one page.
fn one_page(root: &Path, codec: Codec) -> (EncodedPage, Arc<DatasetVersion>) {
    let (store, _) = open(root);
    store.create_dataset("d").unwrap();
    let staging = store.stage("d", "first").unwrap();
    let encoded = encode_as(codec, &small(), &texels(&small(), 0)).unwrap();
    staging.append_encoded(PageId(0), &encoded).unwrap();
    (encoded, staging.publish(publication()).unwrap())
}

/// Of blocks that are unpacked alone only the damaged one is lost.
#[test]
fn a_flipped_byte_costs_its_block_under_every_codec_of_blocks() {
    for codec in Codec::ALL.into_iter().filter(|codec| !codec.is_sequential()) {
        let root = tempfile::tempdir().unwrap();
        let (encoded, version) = one_page(root.path(), codec);
        assert_eq!(unreadable_blocks(&version, 1), [], "{codec}");
        // In the middle lie numbers: nothing but the checksum tells.
        let second = &encoded.blocks[1];
        flip(&only_file(root.path(), "segments"), 40 + 3 * 16 + (second.offset + second.length / 2) as usize);
        assert_eq!(unreadable_blocks(&version, 1), [(0, 1)], "{codec}");
    }
}

/// A sequential codec cannot go on behind the damage, but everything before it is still served.
#[test]
fn a_flipped_byte_in_a_sequential_page_costs_the_rows_from_there_on() {
    for codec in [Codec::ZstdSeq, Codec::LzwSeq] {
        let root = tempfile::tempdir().unwrap();
        let (encoded, version) = one_page(root.path(), codec);
        assert_eq!(version.read_page(PageId(0)).unwrap().to_f32(), texels(&small(), 0));
        flip(&only_file(root.path(), "segments"), 40 + 3 * 16 + encoded.blocks[1].offset as usize + 5);
        assert_eq!(version.read_rows(PageId(0), 3..16).unwrap().to_f32(), written(3..16, 0));
        for rows in [16..17, 39..40, 0..40] {
            let error = version.read_rows(PageId(0), rows.clone()).unwrap_err();
            let StoreError::DamagedPage { page, rows, reason, .. } = &error else { panic!("{error}") };
            assert_eq!((*page, rows.clone(), *reason), (PageId(0), 16..40, "checksum mismatch"), "{codec}");
        }
    }
}

/// Every place in a segment, with the index and without: at most one page suffers, never with wrong texels, and never silently.
#[test]
fn no_flipped_byte_in_a_segment_gives_a_wrong_texel() {
    let root = tempfile::tempdir().unwrap();
    publish(&open(root.path()).0, 3);
    let path = only_file(root.path(), "segments");
    let intact = fs::read(&path).unwrap();
    let (mut harmless, mut harmful) = (0, 0);
    for step in 0..40 {
        // A stride without a common factor with the record's alignment meets headers, tables, payloads and padding.
        let at = step * intact.len() / 40 + step % 7;
        let mut bytes = intact.clone();
        bytes[at] ^= 0x10;
        fs::write(&path, bytes).unwrap();
        if step % 2 == 0 {
            fs::remove_dir_all(root.path().join("index")).unwrap();
        }
        let (store, _) = open(root.path());
        let unreadable = unreadable_blocks(&store.open_version("d", Some(1)).unwrap(), 3);
        let pages: std::collections::BTreeSet<_> = unreadable.iter().map(|(page, _)| page).collect();
        assert!(pages.len() <= 1, "byte {at}: {unreadable:?}");
        if pages.is_empty() { harmless += 1 } else { harmful += 1 }
    }
    assert!(harmful > 30 && harmless < 10, "{harmful} harmful, {harmless} in padding");
}

#[test]
fn a_damaged_header_is_reported_at_opening_when_the_index_is_gone_too() {
    let root = tempfile::tempdir().unwrap();
    publish(&open(root.path()).0, 3);
    flip(&only_file(root.path(), "segments"), 9);
    fs::remove_dir_all(root.path().join("index")).unwrap();
    let (store, report) = open(root.path());
    assert!(
        matches!(&report.damaged[..], [StoreError::DamagedFile { reason, .. }] if reason.starts_with("1 of 3 page headers")),
        "{report:?}"
    );
    assert_eq!(unreadable_blocks(&store.open_version("d", None).unwrap(), 3), [(0, 0), (0, 1), (0, 2)]);
}

#[test]
fn a_cut_segment_serves_what_is_left_of_it() {
    let root = tempfile::tempdir().unwrap();
    publish(&open(root.path()).0, 4);
    let path = only_file(root.path(), "segments");
    let whole = fs::metadata(&path).unwrap().len();
    for cut in (0..16).rev() {
        fs::File::options().write(true).open(&path).unwrap().set_len(whole * cut / 16).unwrap();
        if cut % 2 == 0 {
            fs::remove_dir_all(root.path().join("index")).unwrap();
        }
        let (store, report) = open(root.path());
        assert!(!report.damaged.is_empty());
        let unreadable = unreadable_blocks(&store.open_version("d", None).unwrap(), 4);
        let least = (12 * (16 - cut) / 16).saturating_sub(1) as usize;
        assert!(unreadable.len() >= least.max(1) && unreadable.len() <= 12, "cut at {cut}/16: {unreadable:?}");
        // Only the end is missing.
        assert!(unreadable.windows(2).all(|w| w[0] < w[1]) && *unreadable.last().unwrap() == (3, 2));
    }
}

#[test]
fn a_missing_segment_is_told_and_hurts_no_other_dataset() {
    let root = tempfile::tempdir().unwrap();
    {
        let (store, _) = open(root.path());
        publish(&store, 2);
        store.create_dataset("other").unwrap();
        let staging = store.stage("other", "t").unwrap();
        staging.append_page(PageId(0), &small(), &texels(&small(), 77)).unwrap();
        let other = staging.publish(publication()).unwrap();
        let path = root.path().join(format!("segments/{}.seg", other.manifest().segments[0].blake3));
        fs::remove_file(path).unwrap();
    }
    let (store, report) = open(root.path());
    assert_eq!(report.damaged.len(), 1, "{report:?}");
    assert_whole(&store.open_version("d", None).unwrap(), 2);
    let other = store.open_version("other", None).unwrap();
    assert!(matches!(other.read_page(PageId(0)), Err(StoreError::DamagedPage { page: PageId(0), .. })));
}

#[test]
fn a_damaged_manifest_is_named_and_its_files_are_kept() {
    let root = tempfile::tempdir().unwrap();
    {
        let (store, _) = open(root.path());
        publish(&store, 2);
        let staging = store.stage("d", "second").unwrap();
        staging.append_page(PageId(0), &small(), &texels(&small(), 9)).unwrap();
        staging.publish(publication()).unwrap();
    }
    let manifest = root.path().join("datasets/d/2/manifest.json");
    let intact = fs::read(&manifest).unwrap();
    // Every byte, the hash itself and the last newline included.
    for at in (0..intact.len()).step_by(37).chain([intact.len() - 1]) {
        flip(&manifest, at);
        assert!(Manifest::from_file(&fs::read(&manifest).unwrap(), &manifest).is_err(), "byte {at} goes unnoticed");
        fs::write(&manifest, &intact).unwrap();
    }
    flip(&manifest, 200);
    let (store, report) = open(root.path());
    assert!(report.sweep_withheld && report.swept.is_empty());
    assert!(matches!(&report.damaged[..], [StoreError::DamagedFile { path, .. }] if *path == manifest), "{report:?}");
    assert!(matches!(store.open_version("d", None), Err(StoreError::DamagedFile { .. })));
    assert_whole(&store.open_version("d", Some(1)).unwrap(), 2);
    // Its number is not given away again.
    assert_eq!(store.versions("d").unwrap(), [1, 2]);
    drop(store);
    fs::write(&manifest, &intact).unwrap();
    let (store, report) = open(root.path());
    assert!(report.damaged.is_empty());
    assert_eq!(store.open_version("d", None).unwrap().read_page(PageId(0)).unwrap().to_f32(), texels(&small(), 9));
}

/// One byte changed, or the end cut off, of any file of the store, sled's included: what is served is right, and what is not served is
/// told. Never fewer pages without a word.
#[test]
fn two_hundred_damages_anywhere_are_told_or_harmless_and_never_a_wrong_texel() {
    let origin = tempfile::tempdir().unwrap();
    publish(&open(origin.path()).0, 3);
    let files = files_below(origin.path(), origin.path());
    let mut rng = Pcg32::seed_from_u64(12);
    let (mut told, mut harmless) = (0, 0);
    for step in 0..200usize {
        let root = tempfile::tempdir().unwrap();
        copy_all(&files, origin.path(), root.path());
        // Every file in turn; within it anywhere that something is written.
        let file = &files[step % files.len()];
        let path = root.path().join(file);
        let bytes = fs::read(&path).unwrap();
        let written: Vec<usize> = (0..bytes.len()).filter(|&at| bytes[at] != 0).collect();
        if written.is_empty() {
            fs::write(&path, [0xA5; 64]).unwrap();
        } else if rng.random_range(0..3u32) == 0 {
            fs::write(&path, &bytes[..written[rng.random_range(0..written.len())]]).unwrap();
        } else {
            flip(&path, written[rng.random_range(0..written.len())]);
        }
        let (store, report) = open(root.path());
        let reported = !report.damaged.is_empty() || report.index != IndexOutcome::Intact;
        // The dataset is there or its absence is told; a version is there or is an error that names the file.
        let unread = match store.open_version("d", None) {
            Ok(version) => {
                assert_eq!(version.page_count(), 3, "{}", file.display());
                let blob_lost = version.blob("geometry").map(|blob| assert_eq!(blob, b"four corners")).is_err();
                unreadable_blocks(&version, 3).len() + usize::from(blob_lost)
            }
            Err(error) => {
                assert!(matches!(error, StoreError::DamagedFile { .. }) && !report.damaged.is_empty(), "{}: {error}", file.display());
                1
            }
        };
        if unread > 0 || reported { told += 1 } else { harmless += 1 }
    }
    assert!(told > 100, "{told} told, {harmless} harmless");
}

fn files_below(folder: &Path, root: &Path) -> Vec<PathBuf> {
    let mut entries: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    let below = |path: PathBuf| if path.is_dir() { files_below(&path, root) } else { vec![path.strip_prefix(root).unwrap().into()] };
    entries.into_iter().flat_map(below).collect()
}

fn copy_all(files: &[PathBuf], from: &Path, to: &Path) {
    for file in files {
        fs::create_dir_all(to.join(file).parent().unwrap()).unwrap();
        fs::copy(from.join(file), to.join(file)).unwrap();
    }
}

#[test]
fn a_damaged_blob_is_named() {
    let root = tempfile::tempdir().unwrap();
    let version = publish(&open(root.path()).0, 1);
    flip(&only_file(root.path(), "blobs"), 3);
    assert!(matches!(version.blob("geometry"), Err(StoreError::DamagedFile { .. })));
    assert!(matches!(version.blob("no-such"), Err(StoreError::NotFound { .. })));
    assert!(version.read_page(PageId(0)).is_ok());
}

/// sled opens without an error and lacks some keys or all, or panics, or refuses: the pages are all served in every case.
#[test]
fn no_damage_to_the_index_loses_a_page() {
    let root = tempfile::tempdir().unwrap();
    let index = root.path().join("index");
    // Enough pages that a damage can lose some of their keys and leave others.
    let (tiny, pages) = (shape(1, 1, 1, PixelFormat::F32), 4000);
    {
        let (store, _) = open(root.path());
        store.create_dataset("d").unwrap();
        let staging = store.stage("d", "t").unwrap();
        for page in 0..pages {
            staging.append_page(PageId(page), &tiny, &[page as f32]).unwrap();
        }
        staging.publish(publication()).unwrap();
    }
    let mut rebuilt = 0;
    for step in 0..24usize {
        let files: Vec<_> = fs::read_dir(&index).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_file()).collect();
        let file = &files[step % files.len()];
        let bytes = fs::read(file).unwrap();
        // sled's files are mostly empty: the damage is done where something is written.
        let written: Vec<usize> = (0..bytes.len()).filter(|&at| bytes[at] != 0).collect();
        match (step % 4, written.is_empty()) {
            (_, true) => fs::write(file, [0xA5; 64]).unwrap(),
            (3, _) => fs::write(file, &bytes[..bytes.len() / 2]).unwrap(),
            _ => flip(file, written[step * 7919 % written.len()]),
        }
        let (store, report) = open(root.path());
        assert!(report.damaged.is_empty(), "{report:?}");
        rebuilt += u32::from(report.index != IndexOutcome::Intact);
        let version = store.open_version("d", None).unwrap();
        for page in 0..pages {
            assert_eq!(version.read_page(PageId(page)).unwrap().texel(0, 0)[0], page as f32);
        }
        drop((version, store));
        // And the rebuilt index is a good one.
        assert_eq!(open(root.path()).1.index, IndexOutcome::Intact);
    }
    assert!(rebuilt >= 12, "only {rebuilt} of 24 damages were noticed: the test misses sled's data");
}

#[test]
fn an_index_that_is_gone_or_no_index_is_rebuilt_and_told() {
    let root = tempfile::tempdir().unwrap();
    publish(&open(root.path()).0, 3);
    let index = root.path().join("index");
    fs::remove_dir_all(&index).unwrap();
    let (store, report) = open(root.path());
    assert_eq!(report.index, IndexOutcome::Rebuilt { versions: vec![("d".into(), 1)], reason: "there was none".into() });
    assert_whole(&store.open_version("d", None).unwrap(), 3);
    drop(store);
    fs::remove_dir_all(&index).unwrap();
    fs::write(&index, "not a folder").unwrap();
    let (store, report) = open(root.path());
    assert!(matches!(report.index, IndexOutcome::Rebuilt { .. }), "{report:?}");
    assert_whole(&store.open_version("d", None).unwrap(), 3);
}
