//! Real roots of a polynomial of degree ten, without eigenvalues: between two neighbouring extrema lies at most one root.
//!
//! Roots inside [−1, 1] are found on the polynomial, the others as inverses of those of the reversed polynomial, so that
//! nothing ever overflows. Every extremum is a root of the derivative, one degree lower, and so on down to a line.

const DEGREE: usize = 10;

/// Writes the real roots of `Σ c[i] zⁱ` into `roots`, each once; how many.
pub(super) fn real_roots(c: &[f64; DEGREE + 1], roots: &mut [f64; DEGREE]) -> usize {
    let largest = c.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
    if !(largest.is_finite() && largest > 0.0) {
        return 0;
    }
    let scaled = c.map(|v| v / largest);
    let mut reversed = scaled;
    reversed.reverse();
    let mut inner = [0.0; DEGREE];
    let mut count = roots_in_unit_interval(&scaled, &mut inner);
    roots[..count].copy_from_slice(&inner[..count]);
    let outer = roots_in_unit_interval(&reversed, &mut inner);
    for &w in &inner[..outer] {
        // The ends belong to the first interval.
        if w.abs() < 1.0 && w != 0.0 && count < DEGREE {
            roots[count] = 1.0 / w;
            count += 1;
        }
    }
    count
}

/// Roots in [−1, 1], rising.
fn roots_in_unit_interval(c: &[f64; DEGREE + 1], roots: &mut [f64; DEGREE]) -> usize {
    let mut stops = [0.0; DEGREE + 2];
    let mut found = [0.0; DEGREE];
    let mut count = 0;
    // From the line that is the ninth derivative down to the polynomial itself.
    for order in (0..DEGREE).rev() {
        let (poly, degree) = derivative(c, order);
        stops[0] = -1.0;
        stops[1..=count].copy_from_slice(&found[..count]);
        stops[count + 1] = 1.0;
        let intervals = count + 1;
        count = 0;
        for k in 0..intervals {
            if let Some(root) = root_between(&poly[..=degree], stops[k], stops[k + 1])
                && count < DEGREE
                && (count == 0 || root > found[count - 1])
            {
                found[count] = root;
                count += 1;
            }
        }
    }
    roots[..count].copy_from_slice(&found[..count]);
    count
}

fn derivative(c: &[f64; DEGREE + 1], order: usize) -> ([f64; DEGREE + 1], usize) {
    let mut out = [0.0; DEGREE + 1];
    let mut largest = 0.0_f64;
    for i in order..=DEGREE {
        let factor: f64 = (i - order + 1..=i).map(|k| k as f64).product();
        out[i - order] = c[i] * factor;
        largest = largest.max(out[i - order].abs());
    }
    if largest > 0.0 {
        out.iter_mut().for_each(|v| *v /= largest);
    }
    (out, DEGREE - order)
}

/// The root of a function that is monotonous between `low` and `high`: Newton's method kept in by bisection.
fn root_between(poly: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let value = |z: f64| {
        let (mut v, mut d) = (0.0, 0.0);
        for c in poly.iter().rev() {
            d = d * z + v;
            v = v * z + c;
        }
        (v, d)
    };
    let (at_low, at_high) = (value(low).0, value(high).0);
    if at_low == 0.0 {
        return Some(low);
    }
    if at_low.signum() == at_high.signum() {
        return None;
    }
    let rising = at_low < 0.0;
    let mut z = 0.5 * (low + high);
    for _ in 0..80 {
        let (v, d) = value(z);
        if v == 0.0 {
            return Some(z);
        }
        if (v < 0.0) == rising {
            low = z
        } else {
            high = z
        }
        let newton = z - v / d;
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - z).abs() <= 1e-16 + 1e-15 * z.abs() {
            return Some(next);
        }
        z = next;
    }
    Some(z)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_roots(roots: &[f64]) -> [f64; DEGREE + 1] {
        let mut c = [0.0; DEGREE + 1];
        c[0] = 1.0;
        for (n, r) in roots.iter().enumerate() {
            for i in (0..=n + 1).rev() {
                let below = if i > 0 { c[i - 1] } else { 0.0 };
                c[i] = below - r * c[i];
            }
        }
        c
    }

    #[test]
    fn roots_of_every_size_are_found() {
        let wanted = [-40.0, -3.0, -0.9, -0.2, -1e-3, 0.05, 0.6, 1.7, 9.0, 300.0];
        let mut roots = [0.0; DEGREE];
        let count = real_roots(&with_roots(&wanted), &mut roots);
        let mut found = roots[..count].to_vec();
        found.sort_by(f64::total_cmp);
        assert_eq!(found.len(), wanted.len(), "{found:?}");
        for (f, w) in found.iter().zip(wanted) {
            assert!((f - w).abs() < 1e-6 * w.abs(), "{f} {w}");
        }
    }

    #[test]
    fn complex_roots_are_left_out_and_lower_degrees_are_fine() {
        let mut roots = [0.0; DEGREE];
        let mut c = [0.0; DEGREE + 1];
        (c[0], c[2]) = (1.0, 1.0);
        assert_eq!(real_roots(&c, &mut roots), 0);
        (c[0], c[2]) = (-4.0, 1.0);
        assert_eq!(real_roots(&c, &mut roots), 2);
        assert!((roots[0].abs() - 2.0).abs() < 1e-12);
        assert_eq!(real_roots(&[0.0; DEGREE + 1], &mut roots), 0);
        assert_eq!(real_roots(&[f64::NAN; DEGREE + 1], &mut roots), 0);
    }
}
