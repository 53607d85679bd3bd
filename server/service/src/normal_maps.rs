//! Normal maps that frames show: uploaded files, read when the first frame wants one. Everything here blocks.

use std::sync::Arc;

use lumisphere::formats::normal_map;
use lumisphere::geometry::NormalMap;
use lumisphere::representations::Settings;
use lumisphere::textures::{ContentHash, Store};

use crate::errors::{ApiError, Reason};
use crate::used_last::UsedLast;

/// In memory at once, at most 64 MiB each.
const KEPT: usize = 2;
/// In requests and errors.
const FIELD: &str = "settings.offset_surface_light_field.normal_map.image";

/// The maps that were used last, over the store.
pub struct NormalMaps {
    store: Store,
    kept: UsedLast<NormalMap>,
}

impl NormalMaps {
    /// None yet.
    pub fn new(store: Store) -> Self {
        Self { store, kept: UsedLast::new(KEPT) }
    }

    /// Refuses settings whose map is not here, or cannot be one by its size. Reads none.
    pub fn check(&self, settings: &Settings) -> Result<(), ApiError> {
        let Some(bumps) = settings.bumps() else { return Ok(()) };
        if !self.store.has_blob(&bumps.map) {
            return Err(ApiError::new(Reason::BlobNotFound, format!("{FIELD}: blob {} is not here: upload it first", bumps.map)));
        }
        self.check_bytes(bumps.map)
    }

    /// The map of these settings, where they have one.
    pub fn of(&self, settings: &Settings) -> Result<Option<Arc<NormalMap>>, ApiError> {
        settings.bumps().map(|bumps| self.get(bumps.map)).transpose()
    }

    /// That one.
    pub fn get(&self, hash: ContentHash) -> Result<Arc<NormalMap>, ApiError> {
        self.kept.get(hash, || {
            self.check_bytes(hash)?;
            normal_map::read(&self.store.read_blob(&hash)?).map_err(|e| ApiError::field(FIELD, format!("blob {hash}: {e}")))
        })
    }

    fn check_bytes(&self, hash: ContentHash) -> Result<(), ApiError> {
        match self.store.blob_bytes(&hash)? {
            0..=normal_map::MOST_FILE_BYTES => Ok(()),
            bytes => {
                let problem = format!("blob {hash} has {bytes} bytes, at most {} of a normal map expected", normal_map::MOST_FILE_BYTES);
                Err(ApiError::field(FIELD, problem))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use lumisphere::images::{Rgb8, encode_png};
    use lumisphere::textures::StoreOptions;

    use super::*;

    fn map(red: u8) -> Vec<u8> {
        encode_png(&Rgb8 { width: 1, height: 1, bytes: vec![red, 128, 255] }).unwrap()
    }

    #[test]
    fn the_maps_used_last_are_kept_and_what_is_none_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let maps = NormalMaps::new(store.clone());
        let hashes = [100, 110, 120].map(|red| store.put_upload(&map(red)).unwrap());
        let first = maps.get(hashes[0]).unwrap();
        assert!(Arc::ptr_eq(&first, &maps.get(hashes[0]).unwrap()));
        hashes.iter().for_each(|hash| drop(maps.get(*hash).unwrap()));
        assert!(!Arc::ptr_eq(&first, &maps.get(hashes[0]).unwrap()), "three are kept");
        assert_eq!(maps.kept.len(), KEPT);
        let refused = maps.get(store.put_upload(b"no map").unwrap()).unwrap_err().to_string();
        assert!(refused.starts_with(FIELD) && refused.contains("a PNG of 8 or 16 bits"), "{refused}");
        assert_eq!(maps.get(ContentHash([7; 32])).unwrap_err().reason(), Reason::BlobNotFound);
    }
}
