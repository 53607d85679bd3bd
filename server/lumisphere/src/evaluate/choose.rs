//! The cheapest setting that is good enough, or the best that is cheap enough.

use std::cmp::Ordering;

use thiserror::Error;

use super::pareto::front;
use super::sweep::bytes_text;
use super::{Group, Metric, Sweep};

/// What is asked of a setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Which error.
    pub metric: Metric,
    /// At most this error.
    pub max_error: Option<f64>,
    /// At most this median time of a frame.
    pub max_millis: Option<f64>,
    /// At most so many bytes of the dataset version on disk.
    pub max_bytes: Option<u64>,
}

/// Why nothing was chosen.
#[derive(Debug, Error, PartialEq)]
pub enum ChooseError {
    /// Without a bound, every setting of the front is a choice.
    #[error("no bound: the greatest error, time or number of bytes expected")]
    NoBound,
    /// No row has the error that was asked for, and a time.
    #[error("no row has a figure for {0}")]
    NotMeasured(Metric),
    /// No setting keeps all bounds.
    #[error("no setting keeps the bounds; nearest is {nearest}: {}", misses.join(", "))]
    Unmet {
        /// Its label.
        nearest: String,
        /// Each bound that it misses, and by how much.
        misses: Vec<String>,
    },
}

// One bound, in numbers that compare.
struct Bound {
    coordinate: usize,
    greatest: f64,
}

/// The row (an index into the sweep's) of `group` that keeps the bounds: given an error the fastest, among equally fast ones that of the
/// fewest bytes; given time or bytes alone, that of the least error, then the fastest.
pub fn choose(sweep: &Sweep, group: &Group, bounds: &Bounds) -> Result<usize, ChooseError> {
    let asked = [bounds.max_error, bounds.max_millis, bounds.max_bytes.map(|b| b as f64)];
    let asked: Vec<Bound> = asked.iter().enumerate().filter_map(|(coordinate, b)| Some(Bound { coordinate, greatest: (*b)? })).collect();
    if asked.is_empty() {
        return Err(ChooseError::NoBound);
    }
    let points: Vec<[f64; 3]> = group.rows.iter().map(|i| point(sweep, *i, bounds.metric)).collect();
    // Error first, or cost first.
    let order = if bounds.max_error.is_some() { [1, 2, 0] } else { [0, 1, 2] };
    let rank = |a: &usize, b: &usize| {
        order.iter().map(|k| points[*a][*k].total_cmp(&points[*b][*k])).find(|o| o.is_ne()).unwrap_or(Ordering::Equal)
    };
    let on_front: Vec<usize> = front(&points).into_iter().enumerate().filter(|(_, on)| *on).map(|(i, _)| i).collect();
    // Phrased so that NaN keeps no bound.
    let keeps = |i: &&usize| asked.iter().all(|b| points[**i][b.coordinate] <= b.greatest);
    if let Some(best) = on_front.iter().filter(keeps).copied().min_by(rank) {
        return Ok(group.rows[best]);
    }
    let excess =
        |i: &usize| asked.iter().map(|b| (points[*i][b.coordinate] - b.greatest) / b.greatest.max(f64::MIN_POSITIVE)).fold(0.0, f64::max);
    let nearest = on_front.iter().copied().min_by(|a, b| excess(a).total_cmp(&excess(b)).then(rank(a, b)));
    let nearest = nearest.ok_or(ChooseError::NotMeasured(bounds.metric))?;
    let misses =
        asked.iter().filter(|b| points[nearest][b.coordinate] > b.greatest).map(|b| miss(b, points[nearest][b.coordinate], bounds.metric));
    Err(ChooseError::Unmet { nearest: sweep.labels()[group.rows[nearest]].clone(), misses: misses.collect() })
}

/// Error, milliseconds, bytes.
fn point(sweep: &Sweep, row: usize, metric: Metric) -> [f64; 3] {
    let row = &sweep.rows[row];
    [metric.error(&row.error), row.millis_per_frame, row.dataset_bytes as f64]
}

fn miss(bound: &Bound, value: f64, metric: Metric) -> String {
    let above = value - bound.greatest;
    match bound.coordinate {
        0 => format!("{} is {value:.4}, {above:.4} above {}", metric.label(), bound.greatest),
        1 => format!("a frame takes {value:.2} ms, {above:.2} ms above {} ms", bound.greatest),
        _ => {
            let text = |bytes: f64| bytes_text(bytes as u64);
            format!("the dataset has {}, {} above {}", text(value), text(above), text(bound.greatest))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::sweep::tests::{row, sweep};
    use super::*;

    // Fast and rough, slow and good, and one in between that needs many bytes; the last is beaten by the first.
    fn measured() -> Sweep {
        sweep(vec![
            row("distance", "32", 4.0, 2.0, 1_000_000),
            row("normal", "32", 2.0, 8.0, 1_000_000),
            row("normal", "64", 1.5, 8.0, 4_000_000),
            row("average", "64", 4.5, 2.0, 4_000_000),
        ])
    }

    const NONE: Bounds = Bounds { metric: Metric::DeltaE, max_error: None, max_millis: None, max_bytes: None };

    fn chosen(sweep: &Sweep, bounds: Bounds) -> Result<usize, ChooseError> {
        choose(sweep, &sweep.groups()[0], &bounds)
    }

    #[test]
    fn an_error_bound_gives_the_fastest_and_among_equals_the_smallest() {
        let sweep = measured();
        assert_eq!(chosen(&sweep, Bounds { max_error: Some(5.0), ..NONE }), Ok(0));
        // Both keep it and are equally fast: fewer bytes.
        assert_eq!(chosen(&sweep, Bounds { max_error: Some(2.0), ..NONE }), Ok(1));
        assert_eq!(chosen(&sweep, Bounds { max_error: Some(1.9), ..NONE }), Ok(2));
        assert_eq!(chosen(&sweep, Bounds { metric: Metric::Flip, max_error: Some(0.02), ..NONE }), Ok(1));
    }

    #[test]
    fn time_and_bytes_give_the_least_error() {
        let sweep = measured();
        assert_eq!(chosen(&sweep, Bounds { max_millis: Some(8.0), ..NONE }), Ok(2));
        assert_eq!(chosen(&sweep, Bounds { max_millis: Some(7.9), ..NONE }), Ok(0));
        assert_eq!(chosen(&sweep, Bounds { max_bytes: Some(3_999_999), ..NONE }), Ok(1));
        assert_eq!(chosen(&sweep, Bounds { max_millis: Some(8.0), max_bytes: Some(1_000_000), ..NONE }), Ok(1));
    }

    #[test]
    fn what_cannot_be_kept_is_told_with_the_nearest_and_by_how_much() {
        let sweep = measured();
        let error = chosen(&sweep, Bounds { max_error: Some(1.0), ..NONE }).unwrap_err().to_string();
        assert!(error.contains("nearest is normal(4), face 64: ΔE2000, mean is 1.5000, 0.5000 above 1"), "{error}");
        let error = chosen(&sweep, Bounds { max_error: Some(2.0), max_millis: Some(4.0), ..NONE }).unwrap_err().to_string();
        // Twice the time or twice the error are as far; the fastest is named.
        assert!(error.contains("distance, face 32: ΔE2000, mean is 4.0000, 2.0000 above 2"), "{error}");
        let error = chosen(&sweep, Bounds { max_bytes: Some(900_000), ..NONE }).unwrap_err().to_string();
        assert!(error.contains("the dataset has 1.0 MB, 100 kB above 900 kB"), "{error}");
    }

    #[test]
    fn no_bound_and_no_figure_are_errors() {
        let mut sweep = measured();
        assert_eq!(chosen(&sweep, NONE), Err(ChooseError::NoBound));
        sweep.rows.iter_mut().for_each(|r| r.error.ssim = None);
        let bounds = Bounds { metric: Metric::OneMinusSsim, max_error: Some(1.0), ..NONE };
        assert_eq!(chosen(&sweep, bounds), Err(ChooseError::NotMeasured(Metric::OneMinusSsim)));
    }

    #[test]
    fn a_bound_of_zero_is_kept_by_what_is_exact() {
        let mut sweep = measured();
        sweep.rows[2].error.delta_e_2000_mean = 0.0;
        assert_eq!(chosen(&sweep, Bounds { max_error: Some(0.0), ..NONE }), Ok(2));
    }
}
