//! Reading a scene's JSON with a precise word for every mistake: keys given twice, unknown keys, wrong types, numbers out of range.
//!
//! serde's derive would name neither the path of a wrong value nor accept the format's open set of hints, so values are taken from
//! a small tree by hand.

use std::cell::RefCell;
use std::fmt;

use glam::Vec3;
use serde::de::{Deserialize, Deserializer, Error, MapAccess, SeqAccess, Visitor};

use super::error::SceneError;

/// A JSON value; keys in the order of the file, none twice.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Json {
    Null,
    Bool(bool),
    Number(f64),
    Text(String),
    List(Vec<Json>),
    Map(Vec<(String, Json)>),
}

/// A value and where it stands.
#[derive(Debug, Clone)]
pub(super) struct Node<'a> {
    file: &'a str,
    place: String,
    value: &'a Json,
}

/// The keys of one map, taken one by one; `finish` refuses what nobody took.
pub(super) struct Fields<'a> {
    node: Node<'a>,
    entries: &'a [(String, Json)],
    known: RefCell<Vec<&'static str>>,
}

impl Json {
    pub fn parse(file: &str, bytes: &[u8]) -> Result<Self, SceneError> {
        serde_json::from_slice(bytes).map_err(|e| SceneError::Json { file: file.to_owned(), message: e.to_string() })
    }
}

impl<'a> Node<'a> {
    pub fn root(file: &'a str, value: &'a Json) -> Self {
        Self { file, place: String::from("scene"), value }
    }

    /// `file: place`, for errors that come from elsewhere.
    pub fn at(&self) -> String {
        format!("{} in {}", self.place, self.file)
    }

    pub fn is_list(&self) -> bool {
        matches!(self.value, Json::List(_))
    }

    /// The error "`place` is ..., `expected` expected".
    pub fn wrong(&self, expected: impl Into<String>) -> SceneError {
        SceneError::Value { file: self.file.to_owned(), place: self.place.clone(), value: shown(self.value), expected: expected.into() }
    }

    pub fn duplicate(&self, name: &str) -> SceneError {
        SceneError::Duplicate { file: self.file.to_owned(), place: self.place.clone(), name: name.to_owned() }
    }

    pub fn fields(&self) -> Result<Fields<'a>, SceneError> {
        match self.value {
            Json::Map(entries) => Ok(Fields { node: self.clone(), entries, known: RefCell::default() }),
            _ => Err(self.wrong("an object {…}")),
        }
    }

    /// Every entry of a map whose keys are names.
    pub fn named(&self) -> Result<Vec<(&'a str, Node<'a>)>, SceneError> {
        match self.value {
            Json::Map(entries) => Ok(entries.iter().map(|(k, v)| (k.as_str(), self.below(&format!(".{k}"), v))).collect()),
            _ => Err(self.wrong("an object {…}")),
        }
    }

    pub fn list(&self) -> Result<Vec<Node<'a>>, SceneError> {
        match self.value {
            Json::List(items) => Ok(items.iter().enumerate().map(|(i, v)| self.below(&format!("[{i}]"), v)).collect()),
            _ => Err(self.wrong("a list […]")),
        }
    }

    pub fn text(&self) -> Result<&'a str, SceneError> {
        match self.value {
            Json::Text(text) => Ok(text),
            _ => Err(self.wrong("a string")),
        }
    }

    /// Text that is not empty.
    pub fn name(&self) -> Result<&'a str, SceneError> {
        self.text().ok().filter(|t| !t.is_empty()).ok_or_else(|| self.wrong("a name"))
    }

    pub fn flag(&self) -> Result<bool, SceneError> {
        match self.value {
            Json::Bool(flag) => Ok(*flag),
            _ => Err(self.wrong("true or false")),
        }
    }

    /// Finite as f32.
    pub fn number(&self) -> Result<f32, SceneError> {
        match self.value {
            Json::Number(n) if (*n as f32).is_finite() => Ok(*n as f32),
            _ => Err(self.wrong("a finite number")),
        }
    }

    pub fn number_in(&self, range: std::ops::RangeInclusive<f32>) -> Result<f32, SceneError> {
        self.number()
            .ok()
            .filter(|n| range.contains(n))
            .ok_or_else(|| self.wrong(format!("a number from {} to {}", range.start(), range.end())))
    }

    /// Above zero.
    pub fn length(&self) -> Result<f32, SceneError> {
        self.number().ok().filter(|n| *n > 0.0).ok_or_else(|| self.wrong("a number above 0"))
    }

    pub fn count(&self, range: std::ops::RangeInclusive<u32>) -> Result<u32, SceneError> {
        match self.value {
            Json::Number(n) if n.fract() == 0.0 && (*range.start() as f64..=*range.end() as f64).contains(n) => Ok(*n as u32),
            _ => Err(self.wrong(format!("a whole number from {} to {}", range.start(), range.end()))),
        }
    }

    pub fn numbers<const N: usize>(&self) -> Result<[f32; N], SceneError> {
        let wrong = || self.wrong(format!("{N} finite numbers"));
        let values: Vec<f32> = self.list().map_err(|_| wrong())?.iter().map(Node::number).collect::<Result<_, _>>().map_err(|_| wrong())?;
        values.try_into().map_err(|_| wrong())
    }

    pub fn vec3(&self) -> Result<Vec3, SceneError> {
        self.numbers::<3>().map(Vec3::from)
    }

    /// A direction: not zero; returned with unit length.
    pub fn direction(&self) -> Result<Vec3, SceneError> {
        self.vec3()?.try_normalize().ok_or_else(|| self.wrong("a direction, not zero"))
    }

    /// Radiance, intensity: finite, not negative.
    pub fn light(&self) -> Result<Vec3, SceneError> {
        let expected = "[r, g, b], finite and not negative";
        self.vec3().ok().filter(|c| c.min_element() >= 0.0).ok_or_else(|| self.wrong(expected))
    }

    /// Albedo: three numbers in [0, 1].
    pub fn reflectance(&self) -> Result<Vec3, SceneError> {
        let expected = "[r, g, b], each from 0 to 1";
        self.vec3().ok().filter(|c| c.min_element() >= 0.0 && c.max_element() <= 1.0).ok_or_else(|| self.wrong(expected))
    }

    fn below(&self, step: &str, value: &'a Json) -> Self {
        let place = if self.place == "scene" { step.trim_start_matches('.').to_owned() } else { format!("{}{step}", self.place) };
        Self { file: self.file, place, value }
    }
}

impl<'a> Fields<'a> {
    pub fn node(&self) -> &Node<'a> {
        &self.node
    }

    /// The value of a key; None when absent or null.
    pub fn optional(&self, key: &'static str) -> Option<Node<'a>> {
        self.known.borrow_mut().push(key);
        let (_, value) = self.entries.iter().find(|(k, v)| k == key && !matches!(v, Json::Null))?;
        Some(self.node.below(&format!(".{key}"), value))
    }

    pub fn required(&self, key: &'static str) -> Result<Node<'a>, SceneError> {
        self.optional(key).ok_or_else(|| SceneError::MissingKey {
            file: self.node.file.to_owned(),
            place: self.node.place.clone(),
            key: key.to_owned(),
        })
    }

    /// Refuses keys that nobody asked for. Hints and remarks of other programs (`hint_*`, `about`, …) are passed over.
    pub fn finish(self) -> Result<(), SceneError> {
        const REMARKS: [&str; 7] = ["about", "comment", "author", "license", "source", "credits", "generator"];
        let known = self.known.into_inner();
        let unknown = |k: &str| !(known.contains(&k) || REMARKS.contains(&k) || k.starts_with("hint_"));
        match self.entries.iter().find(|(k, _)| unknown(k)) {
            None => Ok(()),
            Some((key, _)) => Err(SceneError::UnknownKey {
                file: self.node.file.to_owned(),
                place: self.node.place.clone(),
                key: key.clone(),
                known: known.join(", "),
            }),
        }
    }
}

// Values in messages: short, on one line.
fn shown(value: &Json) -> String {
    match value {
        Json::Null => "null".into(),
        Json::Bool(b) => b.to_string(),
        Json::Number(n) => n.to_string(),
        Json::Text(t) => format!("{:?}", t.chars().take(60).collect::<String>()),
        Json::List(items) if items.len() <= 4 => format!("[{}]", items.iter().map(shown).collect::<Vec<_>>().join(", ")),
        Json::List(items) => format!("a list of {}", items.len()),
        Json::Map(_) => "an object {…}".into(),
    }
}

impl<'de> Deserialize<'de> for Json {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(JsonVisitor)
    }
}

struct JsonVisitor;

impl<'de> Visitor<'de> for JsonVisitor {
    type Value = Json;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_unit<E: Error>(self) -> Result<Json, E> {
        Ok(Json::Null)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Json, E> {
        Ok(Json::Bool(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Json, E> {
        Ok(Json::Number(value as f64))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Json, E> {
        Ok(Json::Number(value as f64))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Json, E> {
        Ok(Json::Number(value))
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Json, E> {
        Ok(Json::Text(value.to_owned()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Json, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Json::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Json, A::Error> {
        let mut map: Vec<(String, Json)> = Vec::new();
        let mut seen = std::collections::HashSet::new();
        while let Some((key, value)) = entries.next_entry::<String, Json>()? {
            if !seen.insert(key.clone()) {
                return Err(A::Error::custom(format!("the name {key:?} is given twice")));
            }
            map.push((key, value));
        }
        Ok(Json::Map(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str, take: impl Fn(&Fields) -> Result<(), SceneError>) -> String {
        let json = Json::parse("s.json", text.as_bytes()).unwrap();
        let fields = Node::root("s.json", &json).fields().unwrap();
        take(&fields).and_then(|()| fields.finish()).unwrap_err().to_string()
    }

    #[test]
    fn a_mistake_is_named_with_its_place_its_value_and_what_was_expected() {
        let wrong = error(r#"{"objects":[{"emission":[1,"x",2]}]}"#, |f| {
            f.required("objects")?.list()?[0].fields()?.required("emission")?.light().map(|_| ())
        });
        assert_eq!(wrong, r#"objects[0].emission is [1, "x", 2], [r, g, b], finite and not negative expected: s.json"#);
        let missing = error("{}", |f| f.required("objects").map(|_| ()));
        assert_eq!(missing, r#"scene has no "objects": s.json"#);
        let unknown = error(r#"{"hint_a":1,"about":"","camras":[]}"#, |f| {
            f.optional("cameras");
            Ok(())
        });
        assert_eq!(unknown, r#"scene has an unknown key "camras", one of cameras expected: s.json"#);
    }

    #[test]
    fn a_key_given_twice_is_refused() {
        let twice = Json::parse("s.json", br#"{"materials":{"a":1,"a":2}}"#).unwrap_err().to_string();
        assert!(twice.contains(r#""a" is given twice"#) && twice.contains("line 1"), "{twice}");
    }

    #[test]
    fn numbers_beyond_f32_are_not_finite() {
        assert!(error(r#"{"a":1e39}"#, |f| f.required("a")?.number().map(|_| ())).contains("a finite number expected"));
    }

    #[test]
    fn nesting_without_end_is_an_error_and_not_an_overflow() {
        assert!(Json::parse("s.json", "[".repeat(100_000).as_bytes()).is_err());
    }
}
