//! One pass over the samples: the Gram matrix of everything that variable projection needs (Golub and Pereyra 1973).
//!
//! Columns: 1 and the J lobes (A, linear unknowns), their derivatives by two tangent steps of the axis and by ln m (D), and the residuals
//! of the three channels under the linear unknowns known so far. Residuals, not values: near the minimum they are small, so that sums
//! in f32 keep the digits that differences of large sums would lose.

use crate::fitting::lanes::Lanes;
use crate::fitting::sample::Sample;

/// Smallest cosine whose logarithm is taken.
const LEAST_COSINE: f64 = 1e-6;

/// Samples whose columns are held before they are multiplied: they fit in the nearest cache.
const CHUNK: usize = 16;

/// J lobes: what is not linear.
#[derive(Clone, Copy)]
pub struct Shape<V, const J: usize> {
    /// Unit axes.
    pub axis: [[V; 3]; J],
    /// ln m.
    pub log_exponent: [V; J],
}

/// Two unit tangents of each axis; the second rises towards the pole.
#[derive(Clone, Copy)]
pub struct Frames<V, const J: usize>(pub [[[V; 3]; 2]; J]);

impl<V: Lanes, const J: usize> Shape<V, J> {
    /// Tangents in which an axis is stepped.
    #[inline(always)]
    pub fn frames(&self, token: V::Token) -> Frames<V, J> {
        let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
        let mut frames = [[[zero; 3]; 2]; J];
        for (frame, [x, y, z]) in frames.iter_mut().zip(self.axis) {
            let radius = x.mul_add(x, y * y).sqrt();
            let off_pole = V::splat(token, 1e-5).below(radius);
            let inverse = one / radius.or(off_pole, one);
            let (s, c) = ((y * inverse).or(off_pole, zero), (x * inverse).or(off_pole, one));
            *frame = [[-s, c, zero], [-(z * c), -(z * s), radius]];
        }
        Frames(frames)
    }
}

/// The sums. Q = 1 + J linear unknowns, P = 3 J others, C = 3 if channels have weights of their own, else 1.
#[derive(Clone, Copy)]
pub struct Normal<V, const Q: usize, const P: usize, const C: usize> {
    /// AᵀWA.
    pub aa: [[[V; Q]; Q]; C],
    /// AᵀWD.
    pub ad: [[[V; P]; Q]; C],
    /// DᵀWD.
    pub dd: [[[V; P]; P]; C],
    /// AᵀWr for each channel.
    pub ar: [[V; 3]; Q],
    /// DᵀWr for each channel.
    pub dr: [[V; 3]; P],
    /// rᵀWr, all channels.
    pub rr: V,
}

/// Columns of some samples, times the root of their weight.
struct Columns<V, const Q: usize, const P: usize> {
    a: [[V; Q]; CHUNK],
    d: [[V; P]; CHUNK],
    r: [[V; 3]; CHUNK],
}

/// The sums at `shape`, residuals under `linear`.
#[inline(always)]
pub fn normal<V: Lanes, const J: usize, const Q: usize, const P: usize, const C: usize>(
    token: V::Token,
    samples: &[Sample],
    part: usize,
    shape: &Shape<V, J>,
    frames: &Frames<V, J>,
    linear: &[[V; 3]; Q],
) -> Normal<V, Q, P, C> {
    let zero = V::splat(token, 0.0);
    let mut sums = Normal {
        aa: [[[zero; Q]; Q]; C],
        ad: [[[zero; P]; Q]; C],
        dd: [[[zero; P]; P]; C],
        ar: [[zero; 3]; Q],
        dr: [[zero; 3]; P],
        rr: zero,
    };
    let mut exponent = [zero; J];
    for j in 0..J {
        exponent[j] = shape.log_exponent[j].exp();
    }
    let mut columns = Columns { a: [[zero; Q]; CHUNK], d: [[zero; P]; CHUNK], r: [[zero; 3]; CHUNK] };
    for chunk in samples.chunks(CHUNK) {
        for (k, sample) in chunk.iter().enumerate() {
            fill(token, sample, part, shape, &exponent, frames, linear, &mut columns, k);
        }
        if C == 1 {
            for (k, sample) in chunk.iter().enumerate() {
                let s = V::load(token, &sample.root_weight[0], part);
                columns.a[k].iter_mut().for_each(|x| *x = *x * s);
                columns.d[k].iter_mut().for_each(|x| *x = *x * s);
                columns.r[k].iter_mut().for_each(|x| *x = *x * s);
            }
            gram_shared(token, &columns, chunk.len(), &mut sums);
        } else {
            for c in 0..C {
                gram_channel(token, &columns, chunk, part, c, &mut sums);
            }
        }
    }
    sums
}

#[expect(clippy::too_many_arguments, reason = "the inner loop of `normal`, split off to be read")]
#[inline(always)]
fn fill<V: Lanes, const J: usize, const Q: usize, const P: usize>(
    token: V::Token,
    sample: &Sample,
    part: usize,
    shape: &Shape<V, J>,
    exponent: &[V; J],
    frames: &Frames<V, J>,
    linear: &[[V; 3]; Q],
    columns: &mut Columns<V, Q, P>,
    k: usize,
) {
    let (zero, one) = (V::splat(token, 0.0), V::splat(token, 1.0));
    let d = load(token, &sample.direction, part);
    let mut r = load(token, &sample.value, part);
    columns.a[k][0] = one;
    for c in 0..3 {
        r[c] = r[c] - linear[0][c];
    }
    for j in 0..J {
        let cosine = dot(shape.axis[j], d);
        let m = exponent[j];
        let safe = cosine.max(V::splat(token, LEAST_COSINE));
        let log = safe.ln();
        // cᵐ⁻¹ serves the lobe and its derivative by the axis.
        let power = ((m - one) * log).exp().or(zero.below(cosine), zero);
        let lobe = power * safe;
        let slope = power * m;
        columns.a[k][1 + j] = lobe;
        columns.d[k][3 * j] = slope * dot(frames.0[j][0], d);
        columns.d[k][3 * j + 1] = slope * dot(frames.0[j][1], d);
        columns.d[k][3 * j + 2] = lobe * m * log;
        for c in 0..3 {
            r[c] = (-linear[1 + j][c]).mul_add(lobe, r[c]);
        }
    }
    columns.r[k] = r;
}

#[inline(always)]
fn gram_shared<V: Lanes, const Q: usize, const P: usize, const C: usize>(
    token: V::Token,
    columns: &Columns<V, Q, P>,
    count: usize,
    sums: &mut Normal<V, Q, P, C>,
) {
    let zero = V::splat(token, 0.0);
    for i in 0..Q {
        let (mut aa, mut ad, mut ar) = ([zero; Q], [zero; P], [zero; 3]);
        for k in 0..count {
            let x = columns.a[k][i];
            for j in 0..Q {
                aa[j] = x.mul_add(columns.a[k][j], aa[j]);
            }
            for j in 0..P {
                ad[j] = x.mul_add(columns.d[k][j], ad[j]);
            }
            for c in 0..3 {
                ar[c] = x.mul_add(columns.r[k][c], ar[c]);
            }
        }
        add(&mut sums.aa[0][i], aa);
        add(&mut sums.ad[0][i], ad);
        add(&mut sums.ar[i], ar);
    }
    for i in 0..P {
        let (mut dd, mut dr) = ([zero; P], [zero; 3]);
        for k in 0..count {
            let x = columns.d[k][i];
            for j in 0..P {
                dd[j] = x.mul_add(columns.d[k][j], dd[j]);
            }
            for c in 0..3 {
                dr[c] = x.mul_add(columns.r[k][c], dr[c]);
            }
        }
        add(&mut sums.dd[0][i], dd);
        add(&mut sums.dr[i], dr);
    }
    let mut rr = zero;
    for k in 0..count {
        for c in 0..3 {
            rr = columns.r[k][c].mul_add(columns.r[k][c], rr);
        }
    }
    sums.rr = sums.rr + rr;
}

#[inline(always)]
fn gram_channel<V: Lanes, const Q: usize, const P: usize, const C: usize>(
    token: V::Token,
    columns: &Columns<V, Q, P>,
    chunk: &[Sample],
    part: usize,
    c: usize,
    sums: &mut Normal<V, Q, P, C>,
) {
    for (k, sample) in chunk.iter().enumerate() {
        let s = V::load(token, &sample.root_weight[c], part);
        let w = s * s;
        let r = columns.r[k][c];
        for i in 0..Q {
            let x = columns.a[k][i] * w;
            for j in 0..Q {
                sums.aa[c][i][j] = x.mul_add(columns.a[k][j], sums.aa[c][i][j]);
            }
            for j in 0..P {
                sums.ad[c][i][j] = x.mul_add(columns.d[k][j], sums.ad[c][i][j]);
            }
            sums.ar[i][c] = x.mul_add(r, sums.ar[i][c]);
        }
        for i in 0..P {
            let x = columns.d[k][i] * w;
            for j in 0..P {
                sums.dd[c][i][j] = x.mul_add(columns.d[k][j], sums.dd[c][i][j]);
            }
            sums.dr[i][c] = x.mul_add(r, sums.dr[i][c]);
        }
        sums.rr = (r * w).mul_add(r, sums.rr);
    }
}

#[inline(always)]
fn add<V: Lanes, const N: usize>(sums: &mut [V; N], more: [V; N]) {
    for i in 0..N {
        sums[i] = sums[i] + more[i];
    }
}

/// Three rows of a sample.
#[inline(always)]
pub fn load<V: Lanes>(token: V::Token, rows: &[crate::fitting::lanes::Row; 3], part: usize) -> [V; 3] {
    [V::load(token, &rows[0], part), V::load(token, &rows[1], part), V::load(token, &rows[2], part)]
}

/// Scalar product.
#[inline(always)]
pub fn dot<V: Lanes>(a: [V; 3], b: [V; 3]) -> V {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}
