//! Inverses of symmetric positive definite 6x6 matrices, by closed forms for their 3x3 blocks.
//!
//! Pose errors have six components and are marginalised everywhere, so that this is the innermost step.

use nalgebra::{Matrix3, SMatrix, SVector};

pub(crate) type Matrix6 = SMatrix<f64, 6, 6>;
pub(crate) type Vector6 = SVector<f64, 6>;

/// `A B`, unrolled: the library's general product is several times as slow for matrices that are known to be this small.
#[inline]
pub(crate) fn product<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    let mut product = SMatrix::zeros();
    for (column, weights) in product.data.0.iter_mut().zip(&b.data.0) {
        for (of_a, weight) in a.data.0.iter().zip(weights) {
            for (sum, element) in column.iter_mut().zip(of_a) {
                *sum += element * weight;
            }
        }
    }
    product
}

/// `A B^T`.
#[inline]
pub(crate) fn product_transposed<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, C, K>,
) -> SMatrix<f64, R, C> {
    product(a, &b.transpose())
}

/// `S M S` for the diagonal matrix S of some scales.
pub(crate) fn scaled(matrix: &Matrix6, scales: &Vector6) -> Matrix6 {
    Matrix6::from_fn(|row, column| matrix[(row, column)] * (scales[row] * scales[column]))
}

/// The inverse of a matrix and its determinant.
pub(crate) struct Inverse {
    pub(crate) matrix: Matrix6,
    pub(crate) determinant: f64,
}

impl Inverse {
    /// Nothing if the matrix is not positive definite.
    pub(crate) fn of(matrix: &Matrix6) -> Option<Self> {
        let [a, b, d] = [(0, 0), (0, 3), (3, 3)].map(|at| matrix.fixed_view::<3, 3>(at.0, at.1).into_owned());
        let (of_a, a_determinant) = inverse_of_block(&a)?;
        let across = product(&of_a, &b);
        // The Schur complement of the first block.
        let (of_rest, rest_determinant) = inverse_of_block(&(d - product(&b.transpose(), &across)))?;
        let corner = -product(&across, &of_rest);
        let mut inverse = Matrix6::zeros();
        inverse.fixed_view_mut::<3, 3>(0, 0).copy_from(&(of_a - product_transposed(&corner, &across)));
        inverse.fixed_view_mut::<3, 3>(0, 3).copy_from(&corner);
        inverse.fixed_view_mut::<3, 3>(3, 0).copy_from(&corner.transpose());
        inverse.fixed_view_mut::<3, 3>(3, 3).copy_from(&of_rest);
        Some(Self { matrix: inverse, determinant: a_determinant * rest_determinant })
    }
}

fn inverse_of_block(block: &Matrix3<f64>) -> Option<(Matrix3<f64>, f64)> {
    let minor = block.m11 * block.m22 - block.m12 * block.m12;
    let determinant = block.determinant();
    let is_positive = block.m11 > 0.0 && minor > 0.0 && determinant > 0.0;
    Some((block.try_inverse()?, determinant)).filter(|_| is_positive)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_inverse_of_a_positive_definite_matrix_is_found_with_its_determinant() {
        let root = Matrix6::from_fn(|i, j| ((i * 7 + j * 3) % 5) as f64 - 1.5 + if i == j { 3.0 } else { 0.0 });
        let matrix = root * root.transpose();
        let found = Inverse::of(&matrix);
        let expected = matrix.cholesky().map(|cholesky| (cholesky.inverse(), cholesky.determinant()));
        let apart = found.zip(expected).map(|(found, (inverse, determinant))| {
            ((found.matrix - inverse).norm() / inverse.norm()).max((found.determinant / determinant - 1.0).abs())
        });
        assert!(apart.is_some_and(|apart| apart < 1e-10));
    }

    #[test]
    fn other_matrices_have_none() {
        let mut matrix = Matrix6::identity();
        for i in 0..6 {
            matrix[(i, i)] = -1.0;
            assert!(Inverse::of(&matrix).is_none());
            matrix[(i, i)] = 1.0;
        }
        assert!(Inverse::of(&Matrix6::from_element(1.0)).is_none());
    }
}
