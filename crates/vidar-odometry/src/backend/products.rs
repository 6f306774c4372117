//! Products of small matrices that are compiled into whoever calls them, so that they use the caller's vector instructions. Sums are
//! in the order of nalgebra's products: the same bits.

use nalgebra::SMatrix;

/// `a b`.
#[inline(always)]
pub(crate) fn product<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    product_of(|i, k| a[(i, k)], b)
}

/// `aᵀ b`.
#[inline(always)]
pub(crate) fn transposed_product<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, K, R>,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    product_of(|i, k| a[(k, i)], b)
}

/// The product with `b` of the matrix that has these entries.
#[inline(always)]
fn product_of<const R: usize, const K: usize, const C: usize>(
    entry: impl Fn(usize, usize) -> f64,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    let mut out = SMatrix::zeros();
    for j in 0..C {
        for i in 0..R {
            let mut sum = entry(i, 0) * b[(0, j)];
            for k in 1..K {
                sum += entry(i, k) * b[(k, j)];
            }
            out[(i, j)] = sum;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_have_the_bits_of_nalgebra() {
        let mut random = crate::simulate::Random::new(4);
        for _ in 0..100 {
            let a = SMatrix::<f64, 6, 3>::from_fn(|_, _| random.normal());
            let b = SMatrix::<f64, 3, 5>::from_fn(|_, _| random.normal());
            let c = SMatrix::<f64, 6, 4>::from_fn(|_, _| random.normal());
            assert_eq!(product(&a, &b), a * b);
            assert_eq!(transposed_product(&a, &c), a.transpose() * c);
        }
    }
}
