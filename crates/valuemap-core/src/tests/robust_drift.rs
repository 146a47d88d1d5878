//! Pose errors against dense linear algebra: the whole covariance of all residuals, written out.

use crate::robust::noise::Sigmas;
use crate::robust::noise::drift::{DRIFT_LENGTH_M, Drive, Look, Normals, OneLook, SEGMENT_M};
use crate::robust::noise::poses::{Belief, Segments, smooth};
use crate::robust::scene::View;
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use proptest::prelude::*;

type Vector6 = nalgebra::SVector<f64, 6>;

const LABELS: usize = 3;

/// Errors of segments.
fn segments() -> impl Strategy<Value = Sigmas> {
    prop_oneof![Just(Sigmas::NONE), Just(Sigmas { position_m: 0.8, rotation_rad: 0.1 })]
}

fn times(sigmas: Sigmas, factor: f64) -> Sigmas {
    Sigmas { position_m: sigmas.position_m * factor, rotation_rad: sigmas.rotation_rad * factor }
}

/// What comes before a look: another label of the same image, another image of the same place, perhaps with a look at the same label, or a place so far on
/// that it is a segment of its own.
#[derive(Debug, Clone, Copy)]
enum Step {
    Label,
    Image { stays: bool },
    Segment(f64),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        Just(Step::Label),
        any::<bool>().prop_map(|stays| Step::Image { stays }),
        ((SEGMENT_M * 1.1)..80.0_f64).prop_map(Step::Segment),
        ((SEGMENT_M * 1.1)..80.0_f64).prop_map(Step::Segment),
    ]
}

/// Looks from several places, each a segment of its own; some images look at several labels, and some say that their poses are worse.
fn looks() -> impl Strategy<Value = Vec<Look>> {
    let look = (prop::array::uniform6(-1.0..1.0_f64), prop::array::uniform8(-1.0..1.0_f64), step(), 0.5..4.0_f64);
    (prop::collection::vec(look, 2..9), segments()).prop_map(|(parts, segment_sigma)| {
        let (mut driven_m, mut image, mut label) = (0.0, 0, 0);
        let of_part = |(turns, rest, step, detection_px2): ([f64; 6], [f64; 8], Step, f64)| {
            match step {
                Step::Label if label + 1 < LABELS => label += 1,
                Step::Image { stays: true } => image += 1,
                Step::Label | Step::Image { .. } => (image, label) = (image + 1, image as usize % LABELS),
                Step::Segment(step) => (driven_m, image, label) = (driven_m + step, image + 1, image as usize % LABELS),
            }
            let worse = if image % 4 == 3 { 2.0 } else { 1.0 };
            Look {
                label,
                image,
                residual: [rest[0] * 3.0, rest[1] * 3.0],
                by_point: [Vector3::new(rest[2], rest[3], rest[4]), Vector3::new(rest[5], rest[6], rest[7])],
                by_turn: [Vector3::from_column_slice(&turns[..3]), Vector3::from_column_slice(&turns[3..])],
                drift_sigma: times(Sigmas { position_m: 0.5, rotation_rad: 0.2 }, worse),
                segment_sigma: times(segment_sigma, worse),
                own_sigma: Sigmas { position_m: 0.3, rotation_rad: 0.4 },
                detection_px2,
                variance: detection_px2 + 1.0,
                driven_m,
            }
        };
        parts.into_iter().map(of_part).collect()
    })
}

proptest! {
    /// What is said of the labels that a visit sees is said of no others.
    #[test]
    fn a_visit_says_of_the_labels_that_it_sees_what_it_says_among_all(looks in looks()) {
        let weights = vec![0.7; looks.len()];
        let mut labels: Vec<usize> = looks.iter().map(|look| look.label).collect();
        labels.sort_unstable();
        labels.dedup();
        let place = |label: usize| labels.partition_point(|&before| before < label);
        let alone: Vec<Look> = looks.iter().map(|look| Look { label: place(look.label), ..look.clone() }).collect();
        let of_those = Drive::along(&alone, &weights, labels.len()).map(|drive| drive.normals);
        let among_all = Drive::along(&looks, &weights, LABELS).map(|drive| drive.normals);
        let (Some(of_those), Some(among_all)) = (of_those, among_all) else {
            return Err(TestCaseError::fail("numbers overflow"));
        };
        let mut spread = Normals::nothing(LABELS);
        spread.add_those_of(&labels, &of_those);
        prop_assert_eq!(spread.information, among_all.information);
        prop_assert_eq!(spread.gradient, among_all.gradient);
        prop_assert_eq!(spread.square.to_bits(), among_all.square.to_bits());
    }
}

fn kernel(a: &Look, b: &Look) -> f64 {
    (-(a.driven_m - b.driven_m).abs() / DRIFT_LENGTH_M).exp()
}

/// Covariance of what two looks' poses have in common along the drive, drift and error of the segment, as it shows in an axis of each.
fn shared((a, i): (&Look, usize), (b, j): (&Look, usize)) -> f64 {
    let both = |a_sigma: &Sigmas, b_sigma: &Sigmas| {
        a.by_pose(i).component_mul(&a_sigma.each()).dot(&b.by_pose(j).component_mul(&b_sigma.each()))
    };
    let of_segment =
        if a.driven_m.to_bits() == b.driven_m.to_bits() { both(&a.segment_sigma, &b.segment_sigma) } else { 0.0 };
    of_segment + kernel(a, b) * both(&a.drift_sigma, &b.drift_sigma)
}

/// Covariance of all residuals, and their derivatives by the positions.
fn dense(looks: &[Look]) -> (DMatrix<f64>, DMatrix<f64>, DVector<f64>) {
    let n = 2 * looks.len();
    let row = |k: usize| (&looks[k / 2], k % 2);
    let scaled = |k: usize, sigma: &Sigmas| row(k).0.by_pose(row(k).1).component_mul(&sigma.each());
    let covariance = DMatrix::from_fn(n, n, |i, j| {
        let (a, b) = (row(i).0, row(j).0);
        let detection = if i == j { a.detection_px2 } else { 0.0 };
        let own = if a.image == b.image { scaled(i, &a.own_sigma).dot(&scaled(j, &b.own_sigma)) } else { 0.0 };
        detection + own + shared((a, i % 2), (b, j % 2))
    });
    let by_point =
        DMatrix::from_fn(
            n,
            3 * LABELS,
            |i, j| {
                if j / 3 == row(i).0.label { row(i).0.by_point[row(i).1][j % 3] } else { 0.0 }
            },
        );
    (covariance, by_point, DVector::from_fn(n, |i, _| row(i).0.residual[row(i).1]))
}

proptest! {
    #[test]
    fn segment_after_segment_is_the_dense_solution(looks in looks(), is_rough in any::<bool>()) {
        let looks: Vec<Look> =
            if is_rough { looks.into_iter().map(Look::by_itself).collect() } else { looks };
        let (covariance, by_point, residual) = dense(&looks);
        let cholesky = covariance.clone().cholesky().ok_or(TestCaseError::fail("not positive definite"))?;
        let information = by_point.transpose() * cholesky.solve(&by_point);
        let gradient = by_point.transpose() * cholesky.solve(&residual);
        let drive = Drive::along(&looks, &vec![1.0; looks.len()], LABELS).ok_or(TestCaseError::fail("no solution"))?;
        let scale = information.norm().max(1.0);
        prop_assert!((&drive.normals.information - &information).norm() < 1e-9 * scale);
        prop_assert!((&drive.normals.gradient - &gradient).norm() < 1e-9 * scale.max(gradient.norm()));
        let square = residual.dot(&cholesky.solve(&residual));
        prop_assert!((drive.normals.square - square).abs() < 1e-9 * square.max(1.0));
        let log_determinant = covariance.determinant().ln();
        prop_assert!((drive.log_determinant() - log_determinant).abs() < 1e-8 * log_determinant.abs().max(1.0));
        // What is left is what drift and segments, given all residuals, does not explain.
        let weighed = cholesky.solve(&residual);
        for (k, found) in drive.left().iter().enumerate() {
            for axis in 0..2 {
                let drift: f64 = (0..2 * looks.len())
                    .map(|j| shared((&looks[k], axis), (&looks[j / 2], j % 2)) * weighed[j])
                    .sum();
                prop_assert!((found[axis] - (looks[k].residual[axis] - drift)).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn one_look_is_a_drive_of_one(looks in looks(), weight in 0.1..1.0_f64) {
        for look in looks.into_iter().map(|look| Look { label: 0, ..look.by_itself() }) {
            let one = OneLook::of(&look, weight).ok_or(TestCaseError::fail("no solution"))?;
            let looks = [look];
            let drive = Drive::along(&looks, &[weight], 1).ok_or(TestCaseError::fail("no solution"))?;
            let (information, gradient) = drive.normals.of_one();
            let is_same = |a: f64, b: f64| (a - b).abs() < 1e-9 * b.abs().max(1.0);
            prop_assert!((one.information - information).norm() < 1e-9 * information.norm().max(1.0));
            prop_assert!((one.gradient - gradient).norm() < 1e-9 * gradient.norm().max(1.0));
            prop_assert!(is_same(one.square, drive.normals.square));
            prop_assert!(is_same(one.log_determinant, drive.log_determinant()));
            prop_assert!((one.left - drive.left()[0]).norm() < 1e-8);
        }
    }

    #[test]
    fn pose_errors_are_the_dense_posterior(looks in looks()) {
        let (covariance, _, residual) = dense(&looks);
        let cholesky = covariance.cholesky().ok_or(TestCaseError::fail("not positive definite"))?;
        let weighed = cholesky.solve(&residual);
        let ones = vec![1.0; looks.len()];
        let drive = Drive::along(&looks, &ones, LABELS).ok_or(TestCaseError::fail("no solution"))?;
        for (look, found) in looks.iter().zip(drive.pose_errors(&ones)) {
            // Covariance of the image's pose error with all residuals, times what they weigh.
            let of_residual = |k: usize| {
                let (other, by_pose) = (&looks[k / 2], looks[k / 2].by_pose(k % 2));
                let both = |one: Sigmas, other: Sigmas| one.each().component_mul(&other.each());
                let drift2 = both(look.drift_sigma, other.drift_sigma) * kernel(look, other);
                let own2 = both(look.own_sigma, other.own_sigma) * f64::from(look.image == other.image);
                let is_one_segment = look.driven_m.to_bits() == other.driven_m.to_bits();
                let segment2 = both(look.segment_sigma, other.segment_sigma) * f64::from(is_one_segment);
                (drift2 + segment2 + own2).component_mul(&by_pose) * weighed[k]
            };
            let expected: Vector6 = (0..2 * looks.len()).map(of_residual).sum();
            prop_assert!((found - expected).norm() < 1e-8);
        }
    }

    /// The smoother takes what a segment has for itself for drift as well.
    #[test]
    fn the_smoother_is_the_dense_posterior(looks in looks()) {
        let votes: Vec<Look> = looks.into_iter().map(Look::by_itself).collect();
        let all_is_drift = |look: &Look| Look { drift_sigma: look.shared_sigma(), segment_sigma: Sigmas::NONE, ..look.clone() };
        let looks: Vec<Look> = votes.iter().map(all_is_drift).collect();
        let mut starts: Vec<f64> = looks.iter().map(|look| look.driven_m).collect();
        starts.dedup();
        let segment_of = |look: &Look| starts.partition_point(|&start| start < look.driven_m);
        let mut beliefs = vec![Belief::nothing(); starts.len()];
        for look in &votes {
            beliefs[segment_of(look)] = beliefs[segment_of(look)].and(&Belief::of_vote(look, look.variance));
        }
        let (covariance, _, residual) = dense(&looks);
        let cholesky = covariance.cholesky().ok_or(TestCaseError::fail("not positive definite"))?;
        let sigma = looks[0].drift_sigma.each();
        for (segment, belief) in smooth(&starts, &beliefs).iter().enumerate() {
            let found = belief.pose_error(looks[0].drift_sigma, Sigmas::NONE);
            // Covariance of this segment's drift with all residuals.
            let cross = DMatrix::from_fn(6, 2 * looks.len(), |i, k| {
                let look = &looks[k / 2];
                let keep = (-(starts[segment] - look.driven_m).abs() / DRIFT_LENGTH_M).exp();
                keep * sigma[i] * look.by_pose(k % 2)[i] * look.drift_sigma.each()[i]
            });
            let mean = -(&cross * cholesky.solve(&residual));
            let prior = DMatrix::from_diagonal(&DVector::from_iterator(6, sigma.iter().map(|s| s * s)));
            let after = prior - &cross * cholesky.solve(&cross.transpose());
            prop_assert!((found.mean - mean.fixed_rows::<6>(0)).norm() < 1e-8);
            prop_assert!((found.covariance - after.fixed_view::<6, 6>(0, 0)).norm() < 1e-8);
        }
    }
}

#[test]
fn segments_are_pieces_of_one_pass() {
    let at = |pass: u32, driven_m: f64| View {
        center: Vector3::zeros(),
        cam_from_world: Matrix3::identity(),
        camera: 0,
        pass,
        viewpoint: 0,
        driven_m,
        position_sigma_m: f64::NAN,
        rotation_sigma_rad: f64::NAN,
    };
    let segments = Segments::new(&[at(1, 0.0), at(0, 25.0), at(0, 3.0), at(0, 9.0), at(1, 11.0), at(0, 20.1)]);
    assert_eq!(segments.of_view, [2, 1, 0, 0, 3, 1]);
    assert_eq!(segments.pass, [0, 0, 1, 1]);
    assert_eq!(segments.start_m, [0.0, 20.0, 0.0, 10.0]);
}
