//! Tables of a TOML file, read key by key with errors that name key, value and what was expected. A key that nobody asked for is an error.

use std::collections::BTreeSet;

use toml::{Table, Value};

use crate::exit::Failure;

/// One table; keys are taken out of it.
pub struct Section {
    // "sweep.toml: capture."; what an error begins with.
    prefix: String,
    table: Table,
    known: BTreeSet<String>,
}

/// What a value must be: a name for errors, and the reading of it.
pub struct Expected<'a, T> {
    /// "16 to 1024".
    pub text: &'a str,
    /// None where the value is not that.
    pub read: &'a dyn Fn(&Value) -> Option<T>,
}

impl Section {
    /// A file's own table. `place` is the file's name.
    pub fn of_text(text: &str, place: &str) -> Result<Self, Failure> {
        let table: Table = toml::from_str(text).map_err(|e| Failure::Usage(format!("{place}: {e}")))?;
        Ok(Self { prefix: format!("{place}: "), table, known: BTreeSet::new() })
    }

    /// The tables under a key: one (`[key]`), several (`[[key]]`) or none.
    pub fn sections(&mut self, key: &str) -> Result<Vec<Self>, Failure> {
        let Some(value) = self.take(key) else { return Ok(Vec::new()) };
        let (values, is_list) = match value {
            Value::Array(values) => (values, true),
            value => (vec![value], false),
        };
        let section = |(i, value): (usize, Value)| {
            let name = if is_list { format!("{key}[{i}]") } else { key.to_string() };
            match value {
                Value::Table(table) => Ok(Self { prefix: format!("{}{name}.", self.prefix), table, known: BTreeSet::new() }),
                other => Err(self.bad(&name, &other, "a table")),
            }
        };
        values.into_iter().enumerate().map(section).collect()
    }

    /// The one table under a key; an empty one where there is none.
    pub fn section(&mut self, key: &str) -> Result<Self, Failure> {
        let empty = || Self { prefix: format!("{}{key}.", self.prefix), table: Table::new(), known: BTreeSet::new() };
        let (none, mut found) = (empty(), self.sections(key)?);
        match found.len() {
            0 => Ok(none),
            1 => Ok(found.remove(0)),
            n => Err(Failure::Usage(format!("{}{key} is there {n} times, one table expected", self.prefix))),
        }
    }

    /// The values of an axis: a list, or one value for a list of one. None without the key; an empty list or a value named twice is an error.
    pub fn axis<T>(&mut self, key: &str, expected: &Expected<'_, T>) -> Result<Option<Vec<T>>, Failure> {
        let Some(value) = self.take(key) else { return Ok(None) };
        let values = match value {
            Value::Array(values) => values,
            value => vec![value],
        };
        if values.is_empty() {
            return Err(Failure::Usage(format!("{}{key} is empty, at least one value expected ({})", self.prefix, expected.text)));
        }
        if let Some(twice) = values.iter().enumerate().find(|(i, v)| values[..*i].contains(v)).map(|(_, v)| v) {
            return Err(Failure::Usage(format!("{}{key} names {twice} twice", self.prefix)));
        }
        values.iter().map(|v| (expected.read)(v).ok_or_else(|| self.bad(key, v, expected.text))).collect::<Result<_, _>>().map(Some)
    }

    /// The one value of a key; None without it.
    pub fn value<T>(&mut self, key: &str, expected: &Expected<'_, T>) -> Result<Option<T>, Failure> {
        let Some(value) = self.take(key) else { return Ok(None) };
        (expected.read)(&value).ok_or_else(|| self.bad(key, &value, expected.text)).map(Some)
    }

    /// All of it: every key is a name of the caller's own.
    pub fn all<T>(self, expected: &Expected<'_, T>) -> Result<Vec<(String, T)>, Failure> {
        let read = |(key, value): (&String, &Value)| {
            let value = (expected.read)(value).ok_or_else(|| self.bad(key, value, expected.text))?;
            Ok((key.clone(), value))
        };
        self.table.iter().map(read).collect()
    }

    /// An error about this section: "sweep.toml: capture.object is missing".
    pub fn error(&self, text: &str) -> Failure {
        Failure::Usage(format!("{}{text}", self.prefix))
    }

    /// Every key must have been asked for.
    pub fn finish(self) -> Result<(), Failure> {
        let Some(unknown) = self.table.keys().next() else { return Ok(()) };
        let known = self.known.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
        Err(self.error(&format!("{unknown} is no key here, one of {known} expected")))
    }

    fn take(&mut self, key: &str) -> Option<Value> {
        self.known.insert(key.into());
        self.table.remove(key)
    }

    fn bad(&self, key: &str, value: &Value, expected: &str) -> Failure {
        self.error(&format!("{key} is {value}, {expected} expected"))
    }
}

/// A whole number within a range, both ends included.
pub fn integer(value: &Value, least: u32, greatest: u32) -> Option<u32> {
    u32::try_from(value.as_integer()?).ok().filter(|n| (least..=greatest).contains(n))
}

/// A finite number, written with or without a point.
pub fn number(value: &Value) -> Option<f32> {
    let number = value.as_float().or_else(|| value.as_integer().map(|i| i as f64))? as f32;
    number.is_finite().then_some(number)
}

/// Text that is not empty.
pub fn text(value: &Value) -> Option<String> {
    value.as_str().filter(|t| !t.is_empty()).map(str::to_string)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn section(text: &str) -> Section {
        Section::of_text(text, "f.toml").unwrap()
    }

    fn size(key: &str, text: &str) -> Result<Option<Vec<u32>>, String> {
        section(text).axis(key, &Expected { text: "1 to 9", read: &|v| integer(v, 1, 9) }).map_err(|e| e.to_string())
    }

    #[test]
    fn an_axis_is_a_list_or_one_value() {
        assert_eq!(size("n", "n = [3, 4]"), Ok(Some(vec![3, 4])));
        assert_eq!(size("n", "n = 3"), Ok(Some(vec![3])));
        assert_eq!(size("n", "m = 3"), Ok(None));
    }

    #[test]
    fn errors_name_key_value_and_what_was_expected() {
        assert_eq!(size("n", "n = [3, 10]").unwrap_err(), "f.toml: n is 10, 1 to 9 expected");
        assert_eq!(size("n", "n = \"3\"").unwrap_err(), "f.toml: n is \"3\", 1 to 9 expected");
        assert_eq!(size("n", "n = []").unwrap_err(), "f.toml: n is empty, at least one value expected (1 to 9)");
        assert_eq!(size("n", "n = [3, 4, 3]").unwrap_err(), "f.toml: n names 3 twice");
        let mut inner = section("[[a]]\nm = 1\n[[a]]\nn = 1.5").sections("a").unwrap();
        let error = inner[1].axis("n", &Expected { text: "1 to 9", read: &|v| integer(v, 1, 9) }).unwrap_err();
        assert_eq!(error.to_string(), "f.toml: a[1].n is 1.5, 1 to 9 expected");
        assert!(section("[[a]]\n[[a]]").section("a").is_err_and(|e| e.to_string().contains("2 times")));
        assert!(Section::of_text("a = ", "f.toml").is_err_and(|e| e.to_string().starts_with("f.toml: ")));
    }

    #[test]
    fn a_key_that_nobody_asked_for_is_refused_with_the_known_ones() {
        let mut s = section("a = 1\nb = 2");
        let any = Expected { text: "", read: &|_| Some(()) };
        s.value("a", &any).unwrap();
        s.value("c", &any).unwrap();
        assert_eq!(s.finish().unwrap_err().to_string(), "f.toml: b is no key here, one of a, c expected");
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        assert_eq!([Value::Float(f64::NAN), Value::Float(1e300), Value::Integer(2)].map(|v| number(&v)), [None, None, Some(2.0)]);
    }
}
