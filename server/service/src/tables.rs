//! Measured BRDFs that frames show: uploaded files, read when the first frame wants one. Everything here blocks.

use std::sync::Arc;

use lumisphere::formats::merl;
use lumisphere::radiometry::brdf::Measured;
use lumisphere::representations::Settings;
use lumisphere::textures::{ContentHash, Store};

use crate::errors::{ApiError, Reason};
use crate::used_last::UsedLast;

/// In memory at once, 17 MB each: those used last.
const KEPT: usize = 4;
/// In requests and errors.
const FIELD: &str = "settings.offset_surface_light_field.gloss.brdf";

/// The tables that were used last, over the store.
pub struct Tables {
    store: Store,
    kept: UsedLast<Measured>,
}

impl Tables {
    /// None yet.
    pub fn new(store: Store) -> Self {
        Self { store, kept: UsedLast::new(KEPT) }
    }

    /// Refuses settings whose table is not here, or cannot be one by its size. Reads none.
    pub fn check(&self, settings: &Settings) -> Result<(), ApiError> {
        let Some(hash) = settings.brdf().and_then(|brdf| brdf.table()) else { return Ok(()) };
        if !self.store.has_blob(&hash) {
            return Err(ApiError::new(Reason::BlobNotFound, format!("{FIELD}: blob {hash} is not here: upload it first")));
        }
        match self.store.blob_bytes(&hash)? {
            merl::FILE_BYTES => Ok(()),
            bytes => Err(ApiError::field(FIELD, format!("blob {hash} has {bytes} bytes, {} of a table expected", merl::FILE_BYTES))),
        }
    }

    /// The table of these settings, where they have one.
    pub fn of(&self, settings: &Settings) -> Result<Option<Arc<Measured>>, ApiError> {
        settings.brdf().and_then(|brdf| brdf.table()).map(|hash| self.get(hash)).transpose()
    }

    /// That one.
    pub fn get(&self, hash: ContentHash) -> Result<Arc<Measured>, ApiError> {
        self.kept.get(hash, || {
            let bytes = self.store.blob_bytes(&hash)?;
            if bytes != merl::FILE_BYTES {
                return Err(ApiError::field(FIELD, format!("blob {hash} has {bytes} bytes, {} of a table expected", merl::FILE_BYTES)));
            }
            merl::read(&self.store.read_blob(&hash)?).map_err(|e| ApiError::field(FIELD, format!("blob {hash}: {e}")))
        })
    }
}

#[cfg(test)]
mod tests {
    use lumisphere::radiometry::brdf::MEASURED_SHAPE;
    use lumisphere::textures::StoreOptions;

    use super::*;

    fn file(value: f64) -> Vec<u8> {
        let count: usize = MEASURED_SHAPE.iter().product();
        let shape = MEASURED_SHAPE.map(|n| n as i32);
        let header = shape.iter().flat_map(|n| n.to_le_bytes());
        header.chain((0..3 * count).flat_map(|_| value.to_le_bytes())).collect()
    }

    #[test]
    fn the_tables_used_last_are_kept_and_what_is_none_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let (store, _) = Store::open(folder.path(), StoreOptions::local()).unwrap();
        let tables = Tables::new(store.clone());
        let hashes: Vec<_> = (0..=KEPT).map(|k| store.put_upload(&file(k as f64)).unwrap()).collect();
        let first = tables.get(hashes[0]).unwrap();
        assert!(Arc::ptr_eq(&first, &tables.get(hashes[0]).unwrap()));
        hashes.iter().for_each(|hash| drop(tables.get(*hash).unwrap()));
        assert!(!Arc::ptr_eq(&first, &tables.get(hashes[0]).unwrap()), "five are kept");
        assert_eq!(tables.kept.len(), KEPT);
        // 2, 3, 4, 0 are kept: 2 is used once more, so that 3 leaves for 1.
        let used_again = tables.get(hashes[2]).unwrap();
        tables.get(hashes[1]).unwrap();
        assert!(Arc::ptr_eq(&used_again, &tables.get(hashes[2]).unwrap()), "what was used last has left");
        let refused = |bytes: &[u8]| tables.get(store.put_upload(bytes).unwrap()).unwrap_err().to_string();
        assert!(refused(b"short").contains("has 5 bytes, 34992012 of a table expected"));
        assert!(refused(&file(f64::NAN)).starts_with("settings.offset_surface_light_field.gloss.brdf: blob "));
        let mut other = file(0.5);
        other[0] = 91;
        assert!(refused(&other).contains("[91, 90, 180]"));
        assert_eq!(tables.get(ContentHash([7; 32])).unwrap_err().reason(), Reason::BlobNotFound);
    }
}
