//! The GPU's twin of `spherical_harmonics.rs`: WGSL with a statement for each function, since compilers keep an array in registers, and lavapipe
//! reads it at once for all lanes, only where every index is a number.

use std::fmt::Write;

use super::spherical_harmonics::spherical_factors;

/// `evaluate_functions(p, scale)`, which leaves `scale` times the spherical functions of `bands` bands toward the unit vector p; and
/// `sum_of_harmonics(first_pair, count)`, the sum of coefficient × function over the first `count` of them, by an `octet(first_pair, low, high)`
/// of coefficients that the kernel has. The recurrences are those of [`Harmonics`](super::Harmonics).
pub(crate) fn harmonics_wgsl(bands: usize) -> String {
    let factors = spherical_factors();
    let mut functions = String::new();
    for m in 0..bands {
        if m == 0 {
            line(&mut functions, format_args!("let cosine_0 = scale;"));
        } else {
            // The sine of order 0 is 0.
            let (x, y) = (format!("p.x * cosine_{}", m - 1), format!("p.y * cosine_{}", m - 1));
            let (x, y) = if m == 1 { (x, y) } else { (format!("{x} - p.y * sine_{}", m - 1), format!("p.x * sine_{} + {y}", m - 1)) };
            line(&mut functions, format_args!("let cosine_{m} = {x};"));
            line(&mut functions, format_args!("let sine_{m} = {y};"));
        }
        line(&mut functions, format_args!("let legendre_{m}_{m} = {:e};", factors.first[m]));
        for l in m..bands {
            if l > m {
                let (rise, fall) = (factors.rise[l][m], factors.fall[l][m]);
                let before = if l > m + 1 { format!(" - {fall:e} * legendre_{}_{m}", l - 2) } else { String::new() };
                line(&mut functions, format_args!("let legendre_{l}_{m} = {rise:e} * p.z * legendre_{}_{m}{before};", l - 1));
            }
            let middle = l * (l + 1);
            line(&mut functions, format_args!("functions[{}] = legendre_{l}_{m} * cosine_{m};", middle + m));
            if m > 0 {
                line(&mut functions, format_args!("functions[{}] = legendre_{l}_{m} * sine_{m};", middle - m));
            }
        }
    }
    let count = bands * bands;
    let mut sum = String::new();
    for first in (0..count).step_by(8) {
        let function = |i: usize| if i < count { format!("functions[{i}]") } else { "0.0".into() };
        let four = |first: usize| (first..first + 4).map(function).collect::<Vec<_>>().join(", ");
        let (low, high, pair) = (four(first), four(first + 4), first / 8 * 3);
        line(&mut sum, format_args!("if count > {first}u {{ sum += octet(first_pair + {pair}u, vec4({low}), vec4({high})); }}"));
    }
    format!(
        "
var<private> functions: array<f32, {}>;

fn evaluate_functions(p: vec3<f32>, scale: f32) {{
{functions}}}

fn sum_of_harmonics(first_pair: u32, count: u32) -> vec3<f32> {{
    var sum = vec3(0.0);
{sum}    return sum;
}}
",
        count.max(1)
    )
}

fn line(text: &mut String, statement: std::fmt::Arguments<'_>) {
    writeln!(text, "    {statement}").expect("memory for a line");
}
