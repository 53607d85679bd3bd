//! Random messages of the wire, by their descriptors: any field, any value, and messages that are right but for a few fields.

use prost::Message;
use prost_reflect::{DynamicMessage, FieldDescriptor, Kind, MapKey, MessageDescriptor, ReflectMessage, Value};
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt};

/// Messages within messages.
const DEPTH: u32 = 8;
/// Where arithmetic breaks.
const NUMBERS: [f64; 20] = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    2.0,
    90.0,
    1e-45,
    1e-30,
    1e-6,
    1e6,
    1e30,
    3.4e38,
    -3.4e38,
    1e300,
    f64::INFINITY,
    f64::NEG_INFINITY,
    f64::NAN,
    f64::MIN_POSITIVE,
    16_777_216.0,
];
const COUNTS: [u64; 14] = [0, 1, 2, 3, 7, 16, 64, 255, 4096, 1 << 20, u32::MAX as u64, i32::MAX as u64, i64::MAX as u64, u64::MAX];

/// What strings are drawn from beside nonsense: names that mean something to the server.
pub struct Words(pub Vec<String>);

impl Words {
    fn any(&self, rng: &mut impl Rng) -> String {
        match rng.random_range(0..10) {
            0 => String::new(),
            1 => "../../etc/passwd".into(),
            2 => "\u{202e}ä\0\n".into(),
            3 => "x".repeat(rng.random_range(1..20_000)),
            4 => format!("{:064x}", rng.random::<u128>()),
            _ => self.0.choose(rng).cloned().unwrap_or_default(),
        }
    }
}

/// A message with some of its fields.
pub fn any(kind: &MessageDescriptor, words: &Words, rng: &mut impl Rng) -> DynamicMessage {
    any_within(kind, words, rng, DEPTH)
}

fn any_within(kind: &MessageDescriptor, words: &Words, rng: &mut impl Rng, depth: u32) -> DynamicMessage {
    let mut message = DynamicMessage::new(kind.clone());
    for field in kind.fields().filter(|field| depth > 0 || !matches!(field.kind(), Kind::Message(_))) {
        if rng.random_bool(0.7) {
            message.set_field(&field, any_of(&field, words, rng, depth));
        }
    }
    message
}

fn any_of(field: &FieldDescriptor, words: &Words, rng: &mut impl Rng, depth: u32) -> Value {
    let count = if rng.random_bool(0.02) { 200 } else { rng.random_range(0..4) };
    if let (true, Kind::Message(entry)) = (field.is_map(), field.kind()) {
        let value = entry.map_entry_value_field();
        return Value::Map((0..count).map(|_| (MapKey::String(words.any(rng)), one(&value, words, rng, depth.min(3)))).collect());
    }
    if !field.is_list() {
        return one(field, words, rng, depth);
    }
    Value::List((0..count).map(|_| one(field, words, rng, depth.min(3))).collect())
}

fn one(field: &FieldDescriptor, words: &Words, rng: &mut impl Rng, depth: u32) -> Value {
    let number = if rng.random_bool(0.5) { *NUMBERS.choose(rng).expect("some") } else { rng.random_range(-10.0..10.0) };
    let count = if rng.random_bool(0.5) { *COUNTS.choose(rng).expect("some") } else { rng.random_range(0..40) };
    match field.kind() {
        Kind::Double => Value::F64(number),
        Kind::Float => Value::F32(number as f32),
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => Value::I32(count as i32),
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => Value::I64(count as i64),
        Kind::Uint32 | Kind::Fixed32 => Value::U32(count as u32),
        Kind::Uint64 | Kind::Fixed64 => Value::U64(count),
        Kind::Bool => Value::Bool(rng.random()),
        Kind::String => Value::String(words.any(rng)),
        Kind::Bytes => Value::Bytes((0..count % 5000).map(|_| rng.random::<u8>()).collect::<Vec<u8>>().into()),
        Kind::Message(kind) => Value::Message(any_within(&kind, words, rng, depth.saturating_sub(1))),
        Kind::Enum(kind) => {
            let known: Vec<i32> = kind.values().map(|value| value.number()).collect();
            Value::EnumNumber(if rng.random_bool(0.1) { count as i32 } else { *known.choose(rng).expect("an enum has values") })
        }
    }
}

/// The message with one field another one, somewhere in it.
pub fn changed(message: &mut DynamicMessage, words: &Words, rng: &mut impl Rng) {
    let fields: Vec<FieldDescriptor> = message.descriptor().fields().collect();
    let Some(field) = fields.choose(rng) else { return };
    let is_there = message.has_field(field);
    match message.get_field_mut(field) {
        Value::Message(inner) if is_there && rng.random_bool(0.85) => changed(inner, words, rng),
        Value::List(many) if !many.is_empty() && rng.random_bool(0.6) => {
            let at = rng.random_range(0..many.len());
            match &mut many[at] {
                Value::Message(inner) => changed(inner, words, rng),
                other => *other = one(field, words, rng, DEPTH),
            }
        }
        _ if rng.random_bool(0.2) => message.clear_field(field),
        _ => message.set_field(field, any_of(field, words, rng, DEPTH)),
    }
}

/// A typed message as one that can be changed.
pub fn dynamic(kind: &MessageDescriptor, message: &impl Message) -> DynamicMessage {
    DynamicMessage::decode(kind.clone(), &message.encode_to_vec()[..]).expect("of that kind")
}

/// Bytes that are hardly a message any more.
pub fn damaged(mut bytes: Vec<u8>, rng: &mut impl Rng) -> Vec<u8> {
    for _ in 0..rng.random_range(1..4) {
        let at = rng.random_range(0..=bytes.len());
        match rng.random_range(0..4) {
            0 => bytes.truncate(at),
            1 => bytes.insert(at, rng.random()),
            2 => bytes.splice(at..at, [0xff; 10]).for_each(drop),
            _ => bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= 1 << rng.random_range(0..8)),
        }
    }
    bytes
}
