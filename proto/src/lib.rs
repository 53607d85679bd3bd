//! The wire of Lumisphere and nothing else: messages, clients and servers generated from `lumisphere/v1alpha1/*.proto`, whose comments
//! are the API reference.

/// Package `lumisphere.v1alpha1`.
pub mod v1alpha1 {
    #![allow(missing_docs, unused_qualifications, clippy::all)]
    tonic::include_proto!("lumisphere.v1alpha1");
}

/// The encoded `FileDescriptorSet` of every file and its imports, for the reflection service.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Greatest request message, bytes.
pub const MAX_REQUEST_BYTES: usize = 4 << 20;
/// Greatest message that holds a frame, bytes: what a client must be ready to receive.
pub const MAX_FRAME_MESSAGE_BYTES: usize = 32 << 20;
/// Greatest chunk of a blob, bytes.
pub const MAX_CHUNK_BYTES: usize = 1 << 20;
/// Greatest payload of MeasureLink, bytes: no more than a chunk of a blob.
pub const MAX_LINK_PAYLOAD_BYTES: usize = 1 << 20;
/// `domain` of every `google.rpc.ErrorInfo`.
pub const ERROR_DOMAIN: &str = "lumisphere";

#[cfg(test)]
mod tests {
    use prost::Message;
    use prost_types::FileDescriptorSet;
    use prost_types::source_code_info::Location;

    use super::FILE_DESCRIPTOR_SET;

    /// Paths (field numbers of `FileDescriptorProto`) of everything that must carry a comment: messages 4, enums 5, services 6, at any depth.
    fn is_documentable(path: &[i32]) -> bool {
        match path {
            [4..=6, _] => true,
            // In a message: field 2, nested message 3, nested enum 4, oneof 8.
            [4, _, rest @ ..] => in_message(rest),
            // In an enum: value 2. In a service: method 2.
            [5 | 6, _, 2, _] => true,
            _ => false,
        }
    }

    fn in_message(path: &[i32]) -> bool {
        match path {
            [2 | 3 | 4 | 8, _] => true,
            [3, _, rest @ ..] => in_message(rest),
            [4, _, 2, _] => true,
            _ => false,
        }
    }

    fn own_locations() -> Vec<(String, Location)> {
        let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
        let own = set.file.into_iter().filter(|f| f.package() == "lumisphere.v1alpha1");
        own.flat_map(|f| {
            let name = f.name().to_string();
            f.source_code_info.unwrap_or_default().location.into_iter().map(move |l| (name.clone(), l))
        })
        .collect()
    }

    #[test]
    fn everything_on_the_wire_has_a_comment() {
        let documentable: Vec<_> = own_locations().into_iter().filter(|(_, l)| is_documentable(&l.path)).collect();
        assert!(documentable.len() > 300, "only {} places seen: source locations are missing", documentable.len());
        for (file, location) in documentable {
            // Generated map entries have no place in the source.
            assert!(!location.leading_comments().trim().is_empty(), "{file}: line {} has no comment", location.span[0] + 1);
        }
    }

    #[test]
    fn enums_begin_with_unspecified() {
        let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).unwrap();
        let own = set.file.iter().filter(|f| f.package() == "lumisphere.v1alpha1");
        let nested = |f: &prost_types::FileDescriptorProto| f.message_type.iter().flat_map(|m| m.enum_type.clone()).collect::<Vec<_>>();
        for e in own.flat_map(|f| f.enum_type.iter().cloned().chain(nested(f)).collect::<Vec<_>>()) {
            assert!(e.value[0].number() == 0 && e.value[0].name().ends_with("_UNSPECIFIED"), "{}: zero is {}", e.name(), e.value[0].name());
        }
    }
}
