//! A sweep as a chart: error against time per frame, bytes as area, a panel a group, the Pareto front of error and time drawn.

use super::pareto::front;
use super::sweep::bytes_text;
use super::{Group, Metric, Sweep, SweepRow};
use crate::charts::{Mark, Panel, Scatter, SizeKey};

/// The chart; `charts::svg` and `charts::png` draw it.
pub fn chart(sweep: &Sweep, metric: Metric) -> Scatter {
    let series = methods(sweep);
    let labels = sweep.labels();
    let panels = sweep.groups().iter().map(|group| panel(sweep, group, metric, &series, &labels)).collect();
    Scatter { panels, series, size_label: "Area: bytes of the dataset on disk".into(), sizes: sizes(sweep) }
}

/// True for each row that no other of its group beats in error and time.
pub fn on_front(sweep: &Sweep, metric: Metric) -> Vec<bool> {
    let mut on = vec![false; sweep.rows.len()];
    for group in sweep.groups() {
        let points: Vec<[f64; 2]> = group.rows.iter().map(|i| point(&sweep.rows[*i], metric)).collect();
        group.rows.iter().zip(front(&points)).for_each(|(row, is_on)| on[*row] = is_on);
    }
    on
}

/// Milliseconds and error.
fn point(row: &SweepRow, metric: Metric) -> [f64; 2] {
    [row.millis_per_frame, metric.error(&row.error)]
}

fn panel(sweep: &Sweep, group: &Group, metric: Metric, series: &[String], labels: &[String]) -> Panel {
    let on_front = on_front(sweep, metric);
    let mark = |i: &usize| {
        let row = &sweep.rows[*i];
        let [x, y] = point(row, metric);
        let figures = format!("{y:.3}, {x:.2} ms, {}", bytes_text(row.dataset_bytes));
        Mark {
            x,
            y,
            size: row.dataset_bytes as f64,
            series: series.iter().position(|s| s == row.method()).unwrap_or_default(),
            on_front: on_front[*i].then(|| [labels[*i].clone(), figures]),
        }
    };
    Panel {
        title: group.name(),
        x_label: "median time of a frame, milliseconds".into(),
        y_label: metric.label().into(),
        marks: group.rows.iter().map(mark).collect(),
    }
}

/// In order of appearance.
fn methods(sweep: &Sweep) -> Vec<String> {
    let mut methods: Vec<String> = Vec::new();
    for row in &sweep.rows {
        if !methods.iter().any(|m| m == row.method()) {
            methods.push(row.method().into());
        }
    }
    methods
}

/// The greatest and, where it differs, the least.
fn sizes(sweep: &Sweep) -> Vec<SizeKey> {
    let bytes = || sweep.rows.iter().map(|r| r.dataset_bytes);
    let key = |bytes: u64| SizeKey { size: bytes as f64, text: bytes_text(bytes) };
    let (greatest, least) = (bytes().max().unwrap_or(0), bytes().min().unwrap_or(0));
    [Some(greatest), Some(least).filter(|l| *l != greatest)].into_iter().flatten().map(key).collect()
}

#[cfg(test)]
mod tests {
    use super::super::sweep::tests::{row, sweep};
    use super::*;
    use crate::charts::svg;

    #[test]
    fn a_panel_a_group_with_a_colour_a_method_and_its_own_front() {
        let mut rows = vec![
            row("distance", "32", 4.0, 2.0, 1_000_000),
            row("normal", "32", 2.0, 8.0, 1_000_000),
            row("normal", "64", 2.5, 9.0, 4_000_000),
            row("normal", "64", 0.1, 1.0, 4_000_000),
        ];
        // Better and faster than all, but of another term.
        (rows[3].component, rows[3].blend, rows[3].exponent) = ("reconstruction".into(), None, None);
        let sweep = sweep(rows);
        let chart = chart(&sweep, Metric::DeltaE);
        assert_eq!((chart.series.as_slice(), chart.panels.len()), (&["distance", "normal", "reconstruction"].map(String::from)[..], 2));
        assert_eq!(on_front(&sweep, Metric::DeltaE), [true, true, false, true]);
        let front: Vec<bool> = chart.panels[0].marks.iter().map(|m| m.on_front.is_some()).collect();
        assert_eq!(front, [true, true, false]);
        assert_eq!(chart.sizes.iter().map(|s| s.text.as_str()).collect::<Vec<_>>(), ["4.0 MB", "1.0 MB"]);
        let text = svg(&chart).unwrap();
        for part in ["mirror of teapot in gazebo, against one_reflection", "distance, face 32", "4.000, 2.00 ms, 1.0 MB"] {
            assert!(text.contains(part), "no {part} in {text}");
        }
    }
}
