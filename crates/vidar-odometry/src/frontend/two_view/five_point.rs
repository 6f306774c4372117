//! Essential matrices through five pairs of rays (Nistér, "An efficient solution to the five-point relative pose problem",
//! PAMI 2004).
//!
//! The five epipolar equations leave E = x·X + y·Y + z·Z + W. The ten cubic conditions on an essential matrix
//! (det E = 0, 2 E Eᵀ E − tr(E Eᵀ) E = 0) are eliminated to a 3 × 3 matrix of polynomials in z, whose determinant of degree
//! ten gives up to ten real solutions.

use super::roots::real_roots;
use nalgebra::{Matrix3, SMatrix, Vector3};

/// Coefficients of x, y, z, 1.
type Linear = [f64; 4];
/// Coefficients of [`QUADRATIC`].
type Quadratic = [f64; 10];
/// Coefficients of [`CUBIC`].
type Cubic = [f64; 20];

const QUADRATIC: [[u8; 3]; 10] = [
    [2, 0, 0],
    [1, 1, 0],
    [0, 2, 0],
    [1, 0, 1],
    [0, 1, 1],
    [0, 0, 2],
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [0, 0, 0],
];

/// Nistér's order: the first ten are eliminated.
const CUBIC: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

const fn index_of(list: &[[u8; 3]], wanted: [u8; 3]) -> usize {
    let mut i = 0;
    while i < list.len() {
        if list[i][0] == wanted[0] && list[i][1] == wanted[1] && list[i][2] == wanted[2] {
            return i;
        }
        i += 1;
    }
    usize::MAX
}

/// `PRODUCT[a][b]` is the place of the product of monomial a of `first` and variable b (x, y, z, 1).
const fn products<const A: usize>(first: &[[u8; 3]; A], into: &[[u8; 3]]) -> [[usize; 4]; A] {
    let mut table = [[0; 4]; A];
    let mut a = 0;
    while a < A {
        let mut b = 0;
        while b < 4 {
            let mut e = first[a];
            if b < 3 {
                e[b] += 1;
            }
            table[a][b] = index_of(into, e);
            b += 1;
        }
        a += 1;
    }
    table
}

const LINEAR: [[u8; 3]; 4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];
const TO_QUADRATIC: [[usize; 4]; 4] = products(&LINEAR, &QUADRATIC);
const TO_CUBIC: [[usize; 4]; 10] = products(&QUADRATIC, &CUBIC);

fn times(a: &Linear, b: &Linear) -> Quadratic {
    let mut out = [0.0; 10];
    for i in 0..4 {
        for j in 0..4 {
            out[TO_QUADRATIC[i][j]] += a[i] * b[j];
        }
    }
    out
}

fn add_product(out: &mut Cubic, a: &Quadratic, b: &Linear, factor: f64) {
    for i in 0..10 {
        for j in 0..4 {
            out[TO_CUBIC[i][j]] += factor * a[i] * b[j];
        }
    }
}

fn combine(terms: &[(f64, &Quadratic)]) -> Quadratic {
    std::array::from_fn(|i| terms.iter().map(|(f, q)| f * q[i]).sum())
}

/// All essential matrices with `bᵀ E a = 0` for the five pairs, written into `found`; how many (at most ten).
pub(super) fn five_point(
    a: &[Vector3<f64>; 5],
    b: &[Vector3<f64>; 5],
    found: &mut [Matrix3<f64>; 10],
) -> usize {
    let mut equations = SMatrix::<f64, 5, 9>::zeros();
    for k in 0..5 {
        for row in 0..3 {
            for column in 0..3 {
                equations[(k, 3 * row + column)] = b[k][row] * a[k][column];
            }
        }
    }
    let Some(basis) = null_space(equations) else { return 0 };
    let e: [[Linear; 3]; 3] =
        std::array::from_fn(|r| std::array::from_fn(|c| std::array::from_fn(|k| basis[(3 * r + c, k)])));
    let Some(reduced) = eliminate(constraints(&e)) else { return 0 };
    let [k, l, m] =
        [(4, 5), (6, 7), (8, 9)].map(|(with_z, without)| subtract_shifted(&reduced, with_z, without));
    let mut roots = [0.0; 10];
    let count = real_roots(&determinant(&k, &l, &m), &mut roots);
    let mut solutions = 0;
    for &z in &roots[..count] {
        if let Some((x, y)) = null_vector(&k, &l, &m, z) {
            let v = basis * nalgebra::Vector4::new(x, y, z, 1.0);
            let matrix = Matrix3::from_row_slice(v.as_slice());
            let norm = matrix.norm();
            if norm.is_finite() && norm > 1e-12 {
                found[solutions] = matrix / norm;
                solutions += 1;
            }
        }
    }
    solutions
}

/// Orthonormal basis of what five equations leave: Gauss-Jordan with complete pivoting, then Gram-Schmidt.
fn null_space(mut m: SMatrix<f64, 5, 9>) -> Option<SMatrix<f64, 9, 4>> {
    let mut order: [usize; 9] = std::array::from_fn(|i| i);
    for step in 0..5 {
        let (mut best, mut at) = (0.0, (step, step));
        for r in step..5 {
            for c in step..9 {
                if m[(r, c)].abs() > best {
                    (best, at) = (m[(r, c)].abs(), (r, c));
                }
            }
        }
        if !(best > 1e-10) {
            return None;
        }
        m.swap_rows(step, at.0);
        m.swap_columns(step, at.1);
        order.swap(step, at.1);
        let pivot = m[(step, step)];
        for c in step..9 {
            m[(step, c)] /= pivot;
        }
        for r in (0..5).filter(|r| *r != step) {
            let factor = m[(r, step)];
            for c in step..9 {
                m[(r, c)] -= factor * m[(step, c)];
            }
        }
    }
    let mut basis = SMatrix::<f64, 9, 4>::zeros();
    for free in 0..4 {
        basis[(order[5 + free], free)] = 1.0;
        for row in 0..5 {
            basis[(order[row], free)] = -m[(row, 5 + free)];
        }
    }
    for column in 0..4 {
        for earlier in 0..column {
            let share = basis.column(column).dot(&basis.column(earlier));
            let other = basis.column(earlier).into_owned();
            basis.column_mut(column).axpy(-share, &other, 1.0);
        }
        let norm = basis.column(column).norm();
        basis.column_mut(column).unscale_mut(norm);
    }
    Some(basis)
}

/// The ten cubic conditions, one a row.
fn constraints(e: &[[Linear; 3]; 3]) -> [Cubic; 10] {
    let mut rows = [[0.0; 20]; 10];
    // E Eᵀ, symmetric.
    let eet: [[Quadratic; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let [p, q, r] = std::array::from_fn(|k| times(&e[i][k], &e[j][k]));
            combine(&[(1.0, &p), (1.0, &q), (1.0, &r)])
        })
    });
    let trace = combine(&[(1.0, &eet[0][0]), (1.0, &eet[1][1]), (1.0, &eet[2][2])]);
    for i in 0..3 {
        for j in 0..3 {
            let row = &mut rows[3 * i + j];
            for k in 0..3 {
                add_product(row, &eet[i][k], &e[k][j], 2.0);
            }
            add_product(row, &trace, &e[i][j], -1.0);
        }
    }
    for (i, [p, q]) in [[1, 2], [2, 0], [0, 1]].into_iter().enumerate() {
        let minor = combine(&[(1.0, &times(&e[1][p], &e[2][q])), (-1.0, &times(&e[1][q], &e[2][p]))]);
        add_product(&mut rows[9], &minor, &e[0][i], 1.0);
    }
    rows
}

/// Gauss-Jordan on the first ten columns with row pivoting.
fn eliminate(mut rows: [Cubic; 10]) -> Option<[Cubic; 10]> {
    for step in 0..10 {
        let pivot = (step..10).max_by(|a, b| rows[*a][step].abs().total_cmp(&rows[*b][step].abs()))?;
        if !(rows[pivot][step].abs() > 1e-14) {
            return None;
        }
        rows.swap(step, pivot);
        let scale = 1.0 / rows[step][step];
        rows[step].iter_mut().for_each(|v| *v *= scale);
        let reference = rows[step];
        for (r, row) in rows.iter_mut().enumerate() {
            if r != step {
                let factor = row[step];
                row.iter_mut().zip(&reference).for_each(|(v, p)| *v -= factor * p);
            }
        }
    }
    Some(rows)
}

/// A row `x·p(z) + y·q(z) + r(z)` with coefficients of rising powers of z.
#[derive(Clone, Copy, Debug)]
struct PolyRow {
    x: [f64; 5],
    y: [f64; 5],
    one: [f64; 5],
}

/// `row_a − z · row_b`, where row a starts with z times the monomial that row b starts with.
fn subtract_shifted(rows: &[Cubic; 10], a: usize, b: usize) -> PolyRow {
    let (ra, rb) = (&rows[a], &rows[b]);
    // Columns 10…12 are x z², x z, x; 13…15 the same of y; 16…19 are z³ … 1.
    let of = |first: usize, degree: usize| {
        let mut poly = [0.0; 5];
        for power in 0..=degree {
            poly[power] += ra[first + degree - power];
            poly[power + 1] -= rb[first + degree - power];
        }
        poly
    };
    PolyRow { x: of(10, 2), y: of(13, 2), one: of(16, 3) }
}

/// Product of polynomials, rising powers.
fn multiply<const A: usize, const B: usize, const C: usize>(a: &[f64; A], b: &[f64; B]) -> [f64; C] {
    let mut out = [0.0; C];
    for i in 0..A {
        for j in 0..B {
            if i + j < C {
                out[i + j] += a[i] * b[j];
            }
        }
    }
    out
}

/// Determinant of the 3 × 3 polynomial matrix, degree ten.
fn determinant(k: &PolyRow, l: &PolyRow, m: &PolyRow) -> [f64; 11] {
    let minor = |p: &[f64; 5], q: &[f64; 5], r: &[f64; 5], s: &[f64; 5]| -> [f64; 8] {
        let (ps, qr): ([f64; 8], [f64; 8]) = (multiply(p, s), multiply(q, r));
        std::array::from_fn(|i| ps[i] - qr[i])
    };
    let a: [f64; 11] = multiply(&minor(&l.y, &l.one, &m.y, &m.one), &k.x);
    let b: [f64; 11] = multiply(&minor(&l.x, &l.one, &m.x, &m.one), &k.y);
    let c: [f64; 11] = multiply(&minor(&l.x, &l.y, &m.x, &m.y), &k.one);
    std::array::from_fn(|i| a[i] - b[i] + c[i])
}

/// x and y that the matrix at `z` sends to zero with 1: the longest cross product of two of its rows.
fn null_vector(k: &PolyRow, l: &PolyRow, m: &PolyRow, z: f64) -> Option<(f64, f64)> {
    let at = |poly: &[f64; 5]| poly.iter().rev().fold(0.0, |sum, c| sum * z + c);
    let [k, l, m] = [k, l, m].map(|row| Vector3::new(at(&row.x), at(&row.y), at(&row.one)).normalize());
    let crosses = [k.cross(&l), l.cross(&m), m.cross(&k)];
    let longest = crosses.iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    (longest.z.abs() > 1e-12).then(|| (longest.x / longest.z, longest.y / longest.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::random::SplitMix64;
    use vidar_core::{LieGroup, Se3, So3};

    #[test]
    fn the_true_matrix_is_among_the_solutions_and_all_are_essential() {
        let mut random = SplitMix64::new(11);
        let mut found = [Matrix3::zeros(); 10];
        for trial in 0..200 {
            let rotation = So3::exp(&(random.normal3() * 0.3));
            let translation = random.normal3().normalize();
            let motion = Se3::new(rotation, translation);
            let a: [Vector3<f64>; 5] = std::array::from_fn(|_| {
                Vector3::new(random.normal(), random.normal(), 4.0 + random.uniform())
            });
            let b = a.map(|p| (motion * p).normalize());
            let a = a.map(|p| p.normalize());
            let truth = translation.cross_matrix() * rotation.matrix();
            let truth = truth / truth.norm();
            let count = five_point(&a, &b, &mut found);
            assert!(count > 0, "trial {trial}");
            let mut nearest = f64::INFINITY;
            for e in &found[..count] {
                for k in 0..5 {
                    assert!(b[k].dot(&(e * a[k])).abs() < 1e-9);
                }
                nearest = nearest.min((e - truth).norm()).min((e + truth).norm());
            }
            assert!(nearest < 1e-6, "trial {trial}: {nearest:.1e} of {count}");
        }
    }

    #[test]
    fn five_times_the_same_ray_gives_nothing() {
        let ray = [Vector3::new(0.1, 0.2, 1.0).normalize(); 5];
        assert_eq!(five_point(&ray, &ray, &mut [Matrix3::zeros(); 10]), 0);
        let nan = [Vector3::repeat(f64::NAN); 5];
        assert_eq!(five_point(&nan, &nan, &mut [Matrix3::zeros(); 10]), 0);
    }
}
