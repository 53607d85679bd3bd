//! Progress on standard error: a bar on a terminal, sparse lines elsewhere.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle as BarStyle};

use crate::output::{Output, ProgressStyle};

/// Between two lines of one stage where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(5);

/// Shows how far work is.
pub struct Meter {
    shown: Shown,
    stage: String,
}

enum Shown {
    Silent,
    Bar(ProgressBar),
    Lines { last: Option<Instant> },
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
}

impl Meter {
    /// As the flags and the terminal say.
    pub fn new(output: Output) -> Self {
        let shown = match output.progress_style() {
            ProgressStyle::Silent => Shown::Silent,
            ProgressStyle::Lines => Shown::Lines { last: None },
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
                bar.set_message(left_text(progress.seconds_left));
            }
            Shown::Lines { last } => {
                let is_due = last.is_none_or(|at| at.elapsed() >= LINE_INTERVAL);
                let is_end = progress.total > 0 && progress.done == progress.total;
                if is_new_stage || is_due || is_end {
                    *last = Some(Instant::now());
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

fn bar() -> ProgressBar {
    let style = BarStyle::with_template("{prefix} [{bar:32}] {pos}/{len} {msg}").expect("the template is constant and well formed");
    ProgressBar::with_draw_target(Some(1), ProgressDrawTarget::stderr()).with_style(style.progress_chars("=> "))
}

fn line_text(progress: Progress<'_>) -> String {
    let Progress { stage, done, total, seconds_left } = progress;
    let count = if total > 0 { format!("{done}/{total}") } else { done.to_string() };
    format!("{stage}: {count} {}", left_text(seconds_left)).trim_end().to_string()
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
        let progress = Progress { stage: "tracing cube maps", done: 3, total: 10, seconds_left: Some(75.0) };
        assert_eq!(line_text(progress), "tracing cube maps: 3/10 about 1 min 15 s left");
        assert_eq!(line_text(Progress { total: 0, seconds_left: None, ..progress }), "tracing cube maps: 3");
    }
}
