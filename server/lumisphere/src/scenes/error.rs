//! Why a scene could not be loaded: file, place in it, what was found and what was expected.

use thiserror::Error;

use super::files::FileError;
use crate::formats::FormatError;
use crate::geometry::MeshError;

/// Why a scene could not be loaded.
#[derive(Debug, Error)]
pub enum SceneError {
    /// A file is missing, too large, outside the scene's folder, or cannot be read.
    #[error("{source} (named by {by})")]
    File {
        /// Who names it: file and place.
        by: String,
        /// Why.
        source: FileError,
    },
    /// Not JSON, or a key given twice.
    #[error("not a JSON scene: {message}: {file}")]
    Json {
        /// Which file.
        file: String,
        /// What and where (line, column).
        message: String,
    },
    /// A value of the scene file is not what its place asks for.
    #[error("{place} is {value}, {expected} expected: {file}")]
    Value {
        /// Which file.
        file: String,
        /// Path inside the JSON, `objects[3].emission`.
        place: String,
        /// What is there (shortened).
        value: String,
        /// What should be.
        expected: String,
    },
    /// A required key is absent.
    #[error("{place} has no {key:?}: {file}")]
    MissingKey {
        /// Which file.
        file: String,
        /// Path inside the JSON.
        place: String,
        /// What is required.
        key: String,
    },
    /// A key that the format does not know: probably a slip of the pen.
    #[error("{place} has an unknown key {key:?}, one of {known} expected: {file}")]
    UnknownKey {
        /// Which file.
        file: String,
        /// Path inside the JSON.
        place: String,
        /// As written.
        key: String,
        /// What is accepted there.
        known: String,
    },
    /// Two objects, cameras or lights share a name.
    #[error("{place} repeats the name {name:?}: {file}")]
    Duplicate {
        /// Which file.
        file: String,
        /// Path inside the JSON, or the kind of thing.
        place: String,
        /// What is there twice.
        name: String,
    },
    /// A mesh, patch or glTF file is broken.
    #[error("{source}: {file}")]
    Format {
        /// Which file.
        file: String,
        /// What is wrong with it.
        source: FormatError,
    },
    /// A texture or environment cannot be decoded or used.
    #[error("{message}: {file}")]
    Image {
        /// Which file.
        file: String,
        /// What is wrong with it.
        message: String,
    },
    /// An object without area, or with numbers that are none.
    #[error("object {object:?}: {source}: {file}")]
    Geometry {
        /// Which file.
        file: String,
        /// Which object.
        object: String,
        /// What is wrong with it.
        source: MeshError,
    },
    /// Beyond what one scene may hold.
    #[error("scene has more than {limit} {what}: {file}")]
    TooMuch {
        /// Which file.
        file: String,
        /// Of what.
        what: &'static str,
        /// How many are accepted.
        limit: usize,
    },
    /// No built-in scene of that name.
    #[error("no built-in scene is named {name:?}, one of {known} expected")]
    UnknownBuiltin {
        /// As asked for.
        name: String,
        /// What there is.
        known: String,
    },
}
