//! Drifting pose errors against dense linear algebra: the whole covariance of all residuals, written out.

use nalgebra::{DMatrix, DVector, Vector3};
use proptest::prelude::*;
use valuemap_core::robust::drift::{DRIFT_LENGTH_M, Drive, LEG_M, Look};
use valuemap_core::robust::poses::{Belief, legs, smooth};

type Vector6 = nalgebra::SVector<f64, 6>;

/// Looks far enough from each other that each is a leg of its own.
fn looks() -> impl Strategy<Value = Vec<Look>> {
    let look = (
        prop::array::uniform12(-1.0..1.0_f64),
        prop::array::uniform8(-1.0..1.0_f64),
        (LEG_M * 1.1)..80.0_f64,
        0.5..4.0_f64,
    );
    prop::collection::vec(look, 2..7).prop_map(|parts| {
        let mut driven_m = 0.0;
        let of_part = |(poses, rest, step, variance): ([f64; 12], [f64; 8], f64, f64)| {
            driven_m += step;
            Look {
                residual: [rest[0] * 3.0, rest[1] * 3.0],
                by_point: [Vector3::new(rest[2], rest[3], rest[4]), Vector3::new(rest[5], rest[6], rest[7])],
                by_pose: [Vector6::from_column_slice(&poses[..6]), Vector6::from_column_slice(&poses[6..])],
                drift_sigma: Vector6::new(0.5, 0.5, 0.5, 0.2, 0.2, 0.2),
                variance,
                driven_m,
            }
        };
        parts.into_iter().map(of_part).collect()
    })
}

fn kernel(a: &Look, b: &Look) -> f64 {
    (-(a.driven_m - b.driven_m).abs() / DRIFT_LENGTH_M).exp()
}

/// Covariance of all residuals, and their derivatives by the point.
fn dense(looks: &[Look]) -> (DMatrix<f64>, DMatrix<f64>, DVector<f64>) {
    let n = 2 * looks.len();
    let row = |k: usize| (&looks[k / 2], k % 2);
    let shared = |k: usize| row(k).0.by_pose[row(k).1].component_mul(&row(k).0.drift_sigma);
    let covariance = DMatrix::from_fn(n, n, |i, j| {
        let own = if i == j { row(i).0.variance } else { 0.0 };
        own + kernel(row(i).0, row(j).0) * shared(i).dot(&shared(j))
    });
    let by_point = DMatrix::from_fn(n, 3, |i, j| row(i).0.by_point[row(i).1][j]);
    (covariance, by_point, DVector::from_fn(n, |i, _| row(i).0.residual[row(i).1]))
}

proptest! {
    #[test]
    fn leg_after_leg_is_the_dense_solution(looks in looks()) {
        let (covariance, by_point, residual) = dense(&looks);
        let cholesky = covariance.clone().cholesky().ok_or(TestCaseError::fail("not positive definite"))?;
        let information = by_point.transpose() * cholesky.solve(&by_point);
        let gradient = by_point.transpose() * cholesky.solve(&residual);
        let drive = Drive::along(&looks, &vec![1.0; looks.len()]).ok_or(TestCaseError::fail("no solution"))?;
        let scale = information.norm().max(1.0);
        prop_assert!((drive.terms.information - information.fixed_view::<3, 3>(0, 0)).norm() < 1e-9 * scale);
        prop_assert!((drive.terms.gradient - gradient.fixed_rows::<3>(0)).norm() < 1e-9 * scale.max(gradient.norm()));
        let square = residual.dot(&cholesky.solve(&residual));
        prop_assert!((drive.terms.square - square).abs() < 1e-9 * square.max(1.0));
        let log_determinant = covariance.determinant().ln();
        prop_assert!((drive.terms.log_determinant - log_determinant).abs() < 1e-8 * log_determinant.abs().max(1.0));
        // What is left is the own variance times the whitened residuals.
        let left = cholesky.solve(&residual);
        for (k, found) in drive.left().iter().enumerate() {
            let expected = [0, 1].map(|i| left[2 * k + i] * looks[k].variance);
            prop_assert!((found.x - expected[0]).abs() < 1e-8 && (found.y - expected[1]).abs() < 1e-8);
        }
    }

    #[test]
    fn the_smoother_is_the_dense_posterior(looks in looks()) {
        let driven_m: Vec<f64> = looks.iter().map(|look| look.driven_m).collect();
        prop_assert_eq!(legs(&driven_m), (0..looks.len()).collect::<Vec<_>>());
        let beliefs: Vec<Belief> = looks.iter().map(|look| Belief::of_vote(look, look.variance)).collect();
        let (covariance, _, residual) = dense(&looks);
        let cholesky = covariance.cholesky().ok_or(TestCaseError::fail("not positive definite"))?;
        for (leg, belief) in smooth(&driven_m, &beliefs).iter().enumerate() {
            let sigma = &looks[leg].drift_sigma;
            let found = belief.pose_error((sigma[0], sigma[3]), (0.0, 0.0));
            // Covariance of this leg's drift with all residuals.
            let cross = DMatrix::from_fn(6, 2 * looks.len(), |i, k| {
                let look = &looks[k / 2];
                kernel(&looks[leg], look) * sigma[i] * look.by_pose[k % 2][i] * look.drift_sigma[i]
            });
            let mean = -(&cross * cholesky.solve(&residual));
            let prior = DMatrix::from_diagonal(&DVector::from_iterator(6, sigma.iter().map(|s| s * s)));
            let after = prior - &cross * cholesky.solve(&cross.transpose());
            prop_assert!((found.mean - mean.fixed_rows::<6>(0)).norm() < 1e-8);
            prop_assert!((found.covariance - after.fixed_view::<6, 6>(0, 0)).norm() < 1e-8);
        }
    }
}
