//! A list of photographs with all that it names, to be uploaded. What is wrong with the list is said before anything is sent.

use std::path::Path;

use bytes::Bytes;
use lumisphere::formats::photograph_list;

use crate::exit::Failure;

/// Of one file of a list: what a server takes of a scene's files, too.
const MOST_FILE_BYTES: u64 = 1 << 30;

/// Files by their path relative to the list's folder.
#[derive(Debug)]
pub struct Packed {
    /// The list's.
    pub list_path: String,
    /// The list first.
    pub files: Vec<(String, Bytes)>,
}

/// Reads the list and every photograph that it names.
pub fn pack(list: &Path) -> anyhow::Result<Packed> {
    let name = list.file_name().and_then(|n| n.to_str()).ok_or_else(|| Failure::Usage(format!("not a UTF-8 name: {}", list.display())))?;
    let folder = list.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let bytes = read(list)?;
    let beside = |file: &str| read(&folder.join(file)).ok().map(Into::into);
    let parsed = photograph_list::read(name, &bytes, &beside).map_err(|e| Failure::Usage(e.to_string()))?;
    let mut files = vec![(name.to_string(), bytes)];
    if name.eq_ignore_ascii_case("images.txt") {
        files.push(("cameras.txt".into(), read(&folder.join("cameras.txt"))?));
    }
    for file in parsed.photographs.iter().flat_map(|p| &p.files) {
        let file = file.strip_prefix("./").unwrap_or(file);
        files.push((file.to_string(), read(&folder.join(file))?));
    }
    Ok(Packed { list_path: name.to_string(), files })
}

fn read(path: &Path) -> anyhow::Result<Bytes> {
    let length = std::fs::metadata(path).map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Failure::NotFound(format!("no such file: {}", path.display())),
        _ => Failure::Usage(format!("{}: {e}", path.display())),
    })?;
    if length.len() > MOST_FILE_BYTES {
        return Err(Failure::Usage(format!("{} has {} bytes, at most {MOST_FILE_BYTES} expected", path.display(), length.len())).into());
    }
    Ok(std::fs::read(path)?.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_is_packed_with_what_it_names_and_what_is_missing_is_said() {
        let folder = tempfile::tempdir().unwrap();
        let list = folder.path().join("dirs.lp");
        assert_eq!(crate::exit::code(&pack(&list).unwrap_err()), 3);
        std::fs::write(&list, "2\na.jpg 0 0 1\nb.jpg 0 0 1\n").unwrap();
        std::fs::write(folder.path().join("a.jpg"), "a").unwrap();
        let missing = pack(&list).unwrap_err();
        assert!(crate::exit::code(&missing) == 3 && missing.to_string().contains("b.jpg"), "{missing}");
        std::fs::write(folder.path().join("b.jpg"), "bb").unwrap();
        let packed = pack(&list).unwrap();
        let names: Vec<(&str, usize)> = packed.files.iter().map(|(name, bytes)| (name.as_str(), bytes.len())).collect();
        assert_eq!((packed.list_path.as_str(), names), ("dirs.lp", vec![("dirs.lp", 26), ("a.jpg", 1), ("b.jpg", 2)]));
        std::fs::write(&list, "3\na.jpg 0 0 1\n").unwrap();
        assert_eq!(crate::exit::code(&pack(&list).unwrap_err()), 2);
    }
}
