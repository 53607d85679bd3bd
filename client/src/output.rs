//! Standard output for results, standard error for talk.

use std::io::{self, IsTerminal, Write};

use serde::Serialize;

/// How to print.
#[derive(Debug, Clone, Copy)]
pub struct Output {
    json: bool,
    quiet: bool,
}

impl Output {
    /// As the flags say.
    pub fn new(json: bool, quiet: bool) -> Self {
        Self { json, quiet }
    }

    /// A command's whole result: one JSON document, or text.
    pub fn document(self, value: &impl Serialize, text: impl FnOnce() -> String) -> io::Result<()> {
        if self.json { print(&serde_json::to_string_pretty(value)?) } else { print(&text()) }
    }

    /// One of many results: one JSON object on a line, or a line of text.
    pub fn line(self, value: &impl Serialize, text: impl FnOnce() -> String) -> io::Result<()> {
        if self.json { print(&serde_json::to_string(value)?) } else { print(&text()) }
    }

    /// Talk: standard error, nothing when quiet.
    pub fn say(self, text: &str) {
        if !self.quiet {
            eprintln!("{text}");
        }
    }

    /// Whether and how to show progress.
    pub fn progress_style(self) -> ProgressStyle {
        match (self.quiet, io::stderr().is_terminal()) {
            (true, _) => ProgressStyle::Silent,
            (false, true) => ProgressStyle::Bar,
            (false, false) => ProgressStyle::Lines,
        }
    }

    /// Results are JSON.
    pub fn is_json(self) -> bool {
        self.json
    }
}

/// How progress is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressStyle {
    /// Not at all.
    Silent,
    /// A bar that redraws itself.
    Bar,
    /// A line now and then: standard error is a file or a pipe.
    Lines,
}

/// Never panics on a closed pipe, unlike `println!`.
fn print(text: &str) -> io::Result<()> {
    let mut out = io::stdout().lock();
    writeln!(out, "{}", text.trim_end_matches('\n'))?;
    out.flush()
}

/// Columns as wide as their widest cell, two spaces between; the first row is the head. Numbers line up when `right` says so.
pub fn table(rows: &[Vec<String>], right: &[usize]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().enumerate().map(|(c, cell)| {
            let pad = " ".repeat(widths[c] - cell.chars().count());
            if right.contains(&c) { pad + cell } else { cell.clone() + &pad }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_string()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// "1.5 GiB".
pub fn bytes_text(bytes: u64) -> String {
    const UNITS: [&str; 4] = ["KiB", "MiB", "GiB", "TiB"];
    let mut value = bytes as f64;
    let mut unit = "B";
    for next in UNITS {
        if value < 1024.0 {
            break;
        }
        (value, unit) = (value / 1024.0, next);
    }
    if unit == "B" { format!("{bytes} B") } else { format!("{value:.1} {unit}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_line_up() {
        let rows = vec![vec!["a".into(), "n".into()], vec!["bbb".into(), "10".into()]];
        assert_eq!(table(&rows, &[1]), "a     n\nbbb  10");
    }

    #[test]
    fn bytes_are_readable() {
        assert_eq!((bytes_text(12), bytes_text(1536)), ("12 B".to_string(), "1.5 KiB".to_string()));
    }
}
