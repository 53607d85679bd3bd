//! CIEDE2000: how different two colours look, 1 being about the smallest difference seen side by side.
//!
//! Source: G. Sharma, W. Wu, E. Dalal, "The CIEDE2000 color-difference formula: implementation notes, supplementary test data,
//! and mathematical observations", Color Research and Application 30(1), 2005; equations 2–22, with kL = kC = kH = 1.

use super::color::Lab;

const POW25_7: f64 = 6_103_515_625.0;

/// ΔE₀₀ of two colours in the standard's scale (L* 0–100). Symmetric, 0 for equal colours.
pub fn delta_e_2000(first: Lab, second: Lab) -> f64 {
    // Equations 2–7: a* stretched near grey, then chroma and hue.
    let mean_chroma = (first.a.hypot(first.b) + second.a.hypot(second.b)) / 2.0;
    let stretch = 1.5 - 0.5 * chroma_switch(mean_chroma);
    let (c1, h1) = polar(first.a * stretch, first.b);
    let (c2, h2) = polar(second.a * stretch, second.b);

    // Equations 8–11.
    let dl = second.l - first.l;
    let dc = c2 - c1;
    let dh = 2.0 * (c1 * c2).sqrt() * (hue_difference(c1 * c2, h1, h2).to_radians() / 2.0).sin();

    // Equations 12–14.
    let l = (first.l + second.l) / 2.0;
    let c = (c1 + c2) / 2.0;
    let h = mean_hue(c1 * c2, h1, h2);

    // Equations 15–21.
    let cos = |degrees: f64| degrees.to_radians().cos();
    let t = 1.0 - 0.17 * cos(h - 30.0) + 0.24 * cos(2.0 * h) + 0.32 * cos(3.0 * h + 6.0) - 0.20 * cos(4.0 * h - 63.0);
    let sl = 1.0 + 0.015 * (l - 50.0).powi(2) / (20.0 + (l - 50.0).powi(2)).sqrt();
    let sc = 1.0 + 0.045 * c;
    let sh = 1.0 + 0.015 * c * t;
    let turn = 30.0 * (-((h - 275.0) / 25.0).powi(2)).exp();
    let rt = -(2.0 * turn).to_radians().sin() * 2.0 * chroma_switch(c);

    // Equation 22. Rounding can leave −0 where the colours agree.
    let (l, c, h) = (dl / sl, dc / sc, dh / sh);
    (l * l + c * c + h * h + rt * c * h).max(0.0).sqrt()
}

/// √(C⁷ / (C⁷ + 25⁷)): 0 near grey, 1 for vivid colours.
fn chroma_switch(chroma: f64) -> f64 {
    let c7 = chroma.powi(7);
    (c7 / (c7 + POW25_7)).sqrt()
}

/// Chroma, and hue in degrees in [0, 360); hue 0 for grey.
fn polar(a: f64, b: f64) -> (f64, f64) {
    (a.hypot(b), b.atan2(a).to_degrees().rem_euclid(360.0))
}

/// Hue from the first to the second colour the short way round, degrees; 0 where either is grey.
fn hue_difference(chroma_product: f64, h1: f64, h2: f64) -> f64 {
    let difference = h2 - h1;
    if chroma_product == 0.0 {
        0.0
    } else if difference > 180.0 {
        difference - 360.0
    } else if difference < -180.0 {
        difference + 360.0
    } else {
        difference
    }
}

/// Mean hue on the short arc, degrees; the sum where either is grey (the grey one's hue is 0).
fn mean_hue(chroma_product: f64, h1: f64, h2: f64) -> f64 {
    let sum = h1 + h2;
    if chroma_product == 0.0 {
        sum
    } else if (h1 - h2).abs() <= 180.0 {
        sum / 2.0
    } else if sum < 360.0 {
        (sum + 360.0) / 2.0
    } else {
        (sum - 360.0) / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Table 1 of the paper: two colours and their difference to four decimals, all 34 pairs.
    #[rustfmt::skip]
    const SHARMA: [([f64; 3], [f64; 3], f64); 34] = [
        ([50.0000, 2.6772, -79.7751], [50.0000, 0.0000, -82.7485], 2.0425),
        ([50.0000, 3.1571, -77.2803], [50.0000, 0.0000, -82.7485], 2.8615),
        ([50.0000, 2.8361, -74.0200], [50.0000, 0.0000, -82.7485], 3.4412),
        ([50.0000, -1.3802, -84.2814], [50.0000, 0.0000, -82.7485], 1.0000),
        ([50.0000, -1.1848, -84.8006], [50.0000, 0.0000, -82.7485], 1.0000),
        ([50.0000, -0.9009, -85.5211], [50.0000, 0.0000, -82.7485], 1.0000),
        ([50.0000, 0.0000, 0.0000], [50.0000, -1.0000, 2.0000], 2.3669),
        ([50.0000, -1.0000, 2.0000], [50.0000, 0.0000, 0.0000], 2.3669),
        ([50.0000, 2.4900, -0.0010], [50.0000, -2.4900, 0.0009], 7.1792),
        ([50.0000, 2.4900, -0.0010], [50.0000, -2.4900, 0.0010], 7.1792),
        ([50.0000, 2.4900, -0.0010], [50.0000, -2.4900, 0.0011], 7.2195),
        ([50.0000, 2.4900, -0.0010], [50.0000, -2.4900, 0.0012], 7.2195),
        ([50.0000, -0.0010, 2.4900], [50.0000, 0.0009, -2.4900], 4.8045),
        ([50.0000, -0.0010, 2.4900], [50.0000, 0.0010, -2.4900], 4.8045),
        ([50.0000, -0.0010, 2.4900], [50.0000, 0.0011, -2.4900], 4.7461),
        ([50.0000, 2.5000, 0.0000], [50.0000, 0.0000, -2.5000], 4.3065),
        ([50.0000, 2.5000, 0.0000], [73.0000, 25.0000, -18.0000], 27.1492),
        ([50.0000, 2.5000, 0.0000], [61.0000, -5.0000, 29.0000], 22.8977),
        ([50.0000, 2.5000, 0.0000], [56.0000, -27.0000, -3.0000], 31.9030),
        ([50.0000, 2.5000, 0.0000], [58.0000, 24.0000, 15.0000], 19.4535),
        ([50.0000, 2.5000, 0.0000], [50.0000, 3.1736, 0.5854], 1.0000),
        ([50.0000, 2.5000, 0.0000], [50.0000, 3.2972, 0.0000], 1.0000),
        ([50.0000, 2.5000, 0.0000], [50.0000, 1.8634, 0.5757], 1.0000),
        ([50.0000, 2.5000, 0.0000], [50.0000, 3.2592, 0.3350], 1.0000),
        ([60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644),
        ([63.0109, -31.0961, -5.8663], [62.8187, -29.7946, -4.0864], 1.2630),
        ([61.2901, 3.7196, -5.3901], [61.4292, 2.2480, -4.9620], 1.8731),
        ([35.0831, -44.1164, 3.7933], [35.0232, -40.0716, 1.5901], 1.8645),
        ([22.7233, 20.0904, -46.6940], [23.0331, 14.9730, -42.5619], 2.0373),
        ([36.4612, 47.8580, 18.3852], [36.2715, 50.5065, 21.2231], 1.4146),
        ([90.8027, -2.0831, 1.4410], [91.1528, -1.6435, 0.0447], 1.4441),
        ([90.9257, -0.5406, -0.9208], [88.6381, -0.8985, -0.7239], 1.5381),
        ([6.7747, -0.2908, -2.4247], [5.8714, -0.0985, -2.2286], 0.6377),
        ([2.0776, 0.0795, -1.1350], [0.9033, -0.0636, -0.5514], 0.9082),
    ];

    #[test]
    fn all_published_pairs_come_out_to_four_decimals_both_ways() {
        let lab = |[l, a, b]: [f64; 3]| Lab { l, a, b };
        for (pair, &(first, second, expected)) in SHARMA.iter().enumerate() {
            for got in [delta_e_2000(lab(first), lab(second)), delta_e_2000(lab(second), lab(first))] {
                assert!((got - expected).abs() < 0.5e-4 + 1e-9, "pair {}: {got}, published {expected}", pair + 1);
            }
        }
    }

    #[test]
    fn equal_colours_do_not_differ() {
        let lab = Lab { l: 31.0, a: -12.5, b: 44.0 };
        assert_eq!(delta_e_2000(lab, lab), 0.0);
    }
}
