//! Rows as comma-separated values (RFC 4180, lines end with a line feed).

use serde::Serialize;
use serde_json::Value;

/// A line a row below a line of names. Nested members become columns, joined by a dot; a row without one of the columns leaves it empty.
pub fn csv<T: Serialize>(rows: &[T]) -> Result<String, serde_json::Error> {
    let rows = rows.iter().map(cells).collect::<Result<Vec<_>, _>>()?;
    let mut columns: Vec<&str> = Vec::new();
    for (name, _) in rows.iter().flatten() {
        if !columns.contains(&name.as_str()) {
            columns.push(name);
        }
    }
    let value = |row: &[(String, String)], column: &str| row.iter().find(|(name, _)| name == column).map_or("", |(_, v)| v).to_string();
    let mut text = line(columns.iter().map(|c| c.to_string()));
    for row in &rows {
        text += &line(columns.iter().map(|column| value(row, column)));
    }
    Ok(text)
}

fn line(cells: impl Iterator<Item = String>) -> String {
    cells.map(|cell| quoted(&cell)).collect::<Vec<_>>().join(",") + "\n"
}

fn quoted(cell: &str) -> String {
    if cell.contains([',', '"', '\n', '\r']) { format!("\"{}\"", cell.replace('"', "\"\"")) } else { cell.to_string() }
}

fn cells<T: Serialize>(row: &T) -> Result<Vec<(String, String)>, serde_json::Error> {
    let mut cells = Vec::new();
    flatten("", &serde_json::to_value(row)?, &mut cells);
    Ok(cells)
}

fn flatten(name: &str, value: &Value, cells: &mut Vec<(String, String)>) {
    let below = |key: &str| if name.is_empty() { key.to_string() } else { format!("{name}.{key}") };
    match value {
        Value::Object(members) => members.iter().for_each(|(key, v)| flatten(&below(key), v, cells)),
        Value::Array(items) => items.iter().enumerate().for_each(|(i, v)| flatten(&below(&i.to_string()), v, cells)),
        Value::Null => cells.push((name.into(), String::new())),
        Value::String(text) => cells.push((name.into(), text.clone())),
        other => cells.push((name.into(), other.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn nested_members_become_columns_and_missing_ones_stay_empty() {
        let rows =
            [json!({ "component": "mirror", "exponent": null, "rmse": { "lab": [0.5, 1.0] } }), json!({ "component": "x", "truth": 1 })];
        assert_eq!(csv(&rows).unwrap(), "component,exponent,rmse.lab.0,rmse.lab.1,truth\nmirror,,0.5,1.0,\nx,,,,1\n");
    }

    #[test]
    fn what_would_break_a_line_is_quoted() {
        let rows = [json!({ "a,b": "one, \"two\"", "c": "first\nsecond" })];
        assert_eq!(csv(&rows).unwrap(), "\"a,b\",c\n\"one, \"\"two\"\"\",\"first\nsecond\"\n");
    }
}
