//! Which points no other point beats (Pareto 1896).

/// True for every point that no other one dominates: at most as large in every coordinate and smaller in one. Equal points do not
/// dominate each other. A point with a coordinate that is not finite is never on the front and dominates nothing.
pub fn front<const D: usize>(points: &[[f64; D]]) -> Vec<bool> {
    let is_known = |p: &[f64; D]| p.iter().all(|x| x.is_finite());
    let is_dominated = |p: &[f64; D]| points.iter().any(|q| is_known(q) && dominates(q, p));
    points.iter().map(|p| is_known(p) && !is_dominated(p)).collect()
}

fn dominates<const D: usize>(q: &[f64; D], p: &[f64; D]) -> bool {
    q.iter().zip(p).all(|(a, b)| a <= b) && q != p
}

#[cfg(test)]
mod tests {
    use super::*;

    fn on_front<const D: usize>(points: &[[f64; D]]) -> Vec<usize> {
        front(points).iter().enumerate().filter(|(_, on)| **on).map(|(i, _)| i).collect()
    }

    #[test]
    fn a_point_is_on_the_front_when_nothing_is_as_good_and_somewhere_better() {
        //   y            3 is right of and above 1; 4 is as high as 2 and further right.
        //   5  0
        //   3     1  3
        //   1        2     4
        assert_eq!(on_front(&[[1.0, 5.0], [2.0, 3.0], [3.0, 1.0], [3.0, 3.0], [5.0, 1.0]]), [0, 1, 2]);
    }

    #[test]
    fn equal_points_share_the_front() {
        assert_eq!(on_front(&[[1.0, 2.0], [1.0, 2.0], [2.0, 2.0], [0.0, 3.0]]), [0, 1, 3]);
    }

    #[test]
    fn a_point_that_is_not_known_neither_wins_nor_stands_in_the_way() {
        assert_eq!(on_front(&[[f64::NAN, 0.0], [1.0, f64::NEG_INFINITY], [1.0, 1.0], [2.0, f64::INFINITY]]), [2]);
        assert_eq!(on_front(&[[f64::NAN, f64::NAN]]), Vec::<usize>::new());
        assert_eq!(on_front::<2>(&[]), Vec::<usize>::new());
    }

    #[test]
    fn a_third_coordinate_keeps_what_two_would_drop() {
        assert_eq!(on_front(&[[1.0, 1.0, 9.0], [2.0, 2.0, 1.0], [2.0, 2.0, 2.0]]), [0, 1]);
    }
}
