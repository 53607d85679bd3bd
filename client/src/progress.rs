//! Progress on standard error: a bar on a terminal, sparse lines elsewhere.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle as BarStyle};

use crate::output::{Output, ProgressStyle};

/// Between two lines of one stage where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
/// Between lines of different stages: a row of short ones (many small files) is not worth a line each.
const STAGE_INTERVAL: Duration = Duration::from_secs(1);

/// Shows how far work is.
pub struct Meter {
    shown: Shown,
    stage: String,
}

enum Shown {
    Silent,
    Bar(ProgressBar),
    Lines(Lines),
}

/// When to print the next line.
#[derive(Default)]
struct Lines {
    last: Option<Instant>,
    has_shown_stage: bool,
}

/// What is shown.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'a> {
    /// What is being done.
    pub stage: &'a str,
    /// Finished pieces.
    pub done: u64,
    /// All pieces; 0 when not known.
    pub total: u64,
    /// Until the stage ends, if known.
    pub seconds_left: Option<f64>,
    /// More to say; may be empty.
    pub detail: &'a str,
}

impl Meter {
    /// As the flags and the terminal say.
    pub fn new(output: Output) -> Self {
        let shown = match output.progress_style() {
            ProgressStyle::Silent => Shown::Silent,
            ProgressStyle::Lines => Shown::Lines(Lines::default()),
            ProgressStyle::Bar => Shown::Bar(bar()),
        };
        Self { shown, stage: String::new() }
    }

    /// Shows a new state.
    pub fn update(&mut self, progress: Progress<'_>) {
        let is_new_stage = self.stage != progress.stage;
        if is_new_stage {
            self.stage = progress.stage.to_string();
        }
        match &mut self.shown {
            Shown::Silent => {}
            Shown::Bar(bar) => {
                bar.set_length(progress.total.max(1));
                bar.set_position(progress.done);
                bar.set_prefix(progress.stage.to_string());
                bar.set_message(after_count(progress));
            }
            Shown::Lines(lines) => {
                if lines.is_due(progress, is_new_stage, Instant::now()) {
                    eprintln!("{}", line_text(progress));
                }
            }
        }
    }

    /// Takes the bar away.
    pub fn finish(self) {
        if let Shown::Bar(bar) = self.shown {
            bar.finish_and_clear();
        }
    }
}

impl Lines {
    /// A stage is announced, its long work told now and then, and its end if it was announced.
    fn is_due(&mut self, progress: Progress<'_>, is_new_stage: bool, now: Instant) -> bool {
        let since = self.last.map(|last| now.duration_since(last));
        let has_passed = |interval: Duration| since.is_none_or(|since| since >= interval);
        let is_end = progress.total > 0 && progress.done == progress.total;
        let is_due = match is_new_stage {
            true => has_passed(STAGE_INTERVAL),
            false => has_passed(LINE_INTERVAL) || (is_end && self.has_shown_stage),
        };
        if is_due {
            self.last = Some(now);
        }
        self.has_shown_stage = (is_due || (self.has_shown_stage && !is_new_stage)) && !is_end;
        is_due
    }
}

fn bar() -> ProgressBar {
    let style = BarStyle::with_template("{prefix} [{bar:32}] {pos}/{len} {msg}").expect("the template is constant and well formed");
    ProgressBar::with_draw_target(Some(1), ProgressDrawTarget::stderr()).with_style(style.progress_chars("=> "))
}

fn line_text(progress: Progress<'_>) -> String {
    let Progress { stage, done, total, .. } = progress;
    let count = if total > 0 { format!("{done}/{total}") } else { done.to_string() };
    format!("{stage}: {count} {}", after_count(progress)).trim_end().to_string()
}

fn after_count(progress: Progress<'_>) -> String {
    let parts = [left_text(progress.seconds_left), progress.detail.to_string()];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("; ")
}

fn left_text(seconds_left: Option<f64>) -> String {
    match seconds_left {
        Some(s) if s >= 60.0 => format!("about {:.0} min {:02.0} s left", (s / 60.0).floor(), s % 60.0),
        Some(s) if s >= 0.0 => format!("about {s:.0} s left"),
        _ => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_stage_count_and_time_left() {
        let progress = Progress { stage: "tracing cube maps", done: 3, total: 10, seconds_left: Some(75.0), detail: "" };
        assert_eq!(line_text(progress), "tracing cube maps: 3/10 about 1 min 15 s left");
        assert_eq!(line_text(Progress { detail: "9 texels/s", ..progress }), "tracing cube maps: 3/10 about 1 min 15 s left; 9 texels/s");
        assert_eq!(line_text(Progress { total: 0, seconds_left: None, ..progress }), "tracing cube maps: 3");
    }

    #[test]
    fn short_stages_get_one_line_among_many_and_a_long_one_its_end() {
        let begun = Instant::now();
        let mut lines = Lines::default();
        let mut told = |stage: u64, done: u64, millis: u64| {
            let progress = Progress { stage: "", done, total: 10, seconds_left: None, detail: "" };
            lines.is_due(progress, done == 0 && stage > 0, begun + Duration::from_millis(millis))
        };
        // Ten files within a second: the first is told.
        let files: Vec<bool> = (1..=10).map(|stage| told(stage, 0, 10 * stage)).collect();
        assert_eq!(files.iter().filter(|told| **told).count(), 1);
        // A stage of 12 s: its beginning, two between, its end; the end once.
        let long: Vec<bool> = [(9, 0, 2000), (9, 1, 4000), (9, 2, 7001), (9, 3, 12_002), (9, 10, 14_000), (9, 10, 14_001)]
            .map(|(s, d, t)| told(s, d, t))
            .into();
        assert_eq!(long, [true, false, true, true, true, false]);
    }
}
