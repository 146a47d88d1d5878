//! Noise of detections that remember their errors: what covariances are estimated with.
//!
//! Boxes of one object wander from image to image: a detector errs alike where pictures are alike, and who draws boxes by hand moves them along. Then many
//! images of a visit say less than as many independent ones. The errors that images have for themselves are taken for an autoregression along each segment of
//! a visit, AR(1): those of successive looks at an object have one correlation, which restricted maximum likelihood tells with the sizes of the errors.
//! Looks count as fewer independent ones then ([`variance_of_alike`](crate::robust::noise::variance_of_alike)). Who votes for what is told by single
//! residuals, which are no larger for that, and positions stay where independent looks put them, as least squares do with covariances that heed correlations (Newey and West, "A simple, positive
//! semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", 1987).

use rayon::prelude::*;

use super::AKAIKE;
use super::residuals::{VisitOf, minus_log_likelihood, search};
use super::shared::stated;
use crate::robust::energy::Placed;
use crate::robust::noise::drift::{self, Look};
use crate::robust::noise::{Known, Noise};
use crate::robust::scene::Scene;

/// Variances become larger or smaller by this factor at most. A tenth of its standard deviation is left of an error then, which is next to nothing.
const MOST_CHANGE: f64 = 100.0;

/// The noise of which the looks at some labels have a correlation; nothing where they are independent, or poses state their errors.
pub(crate) fn remembered(scene: &Scene, noise: &Noise, known: Known, labels: &[&Placed]) -> Option<Noise> {
    if stated(scene).iter().any(Option::is_some) {
        return None;
    }
    let visits: Vec<VisitOf> = labels.iter().filter_map(|label| VisitOf::all(scene, noise, label)).flatten().collect();
    let cost = |p: &[f64; 4]| -> f64 {
        let (noise, correlation) = (changed(noise, p), correlation(p[3]));
        let of_visit = |visit: &VisitOf| of_remembering(&visit.looks(scene, &noise), correlation).unwrap_or(0.0);
        // Summed in the order of the visits, so that threads do not change the result.
        visits.par_iter().map(of_visit).collect::<Vec<f64>>().iter().sum()
    };
    let change = (1.0 / MOST_CHANGE, MOST_CHANGE);
    let is_own_known = known.detection || known.position || known.rotation;
    let found = |most_looks: f64| {
        let bounds = [change, change, change, (1.0, most_looks)];
        search([1.0; 4], bounds, [is_own_known, known.position, known.rotation, most_looks <= 1.0], &cost)
    };
    let remembering = found(looks_of_segment(&visits.iter().map(|v| v.looks(scene, noise)).collect::<Vec<_>>()));
    (remembering[3] > 1.0 && cost(&found(1.0)) - cost(&remembering) > AKAIKE)
        .then(|| Noise { look_correlation: correlation(remembering[3]), ..changed(noise, &remembering) })
}

/// The correlation of successive errors of an autoregression of which so many count as one.
fn correlation(looks_as_one: f64) -> f64 {
    (looks_as_one - 1.0) / (looks_as_one + 1.0)
}

/// A noise with other variances: of what images have for themselves, of the positions of segments, and of their rotations. What drifts keeps its ratio to
/// both.
fn changed(noise: &Noise, &[own, position, rotation, _]: &[f64; 4]) -> Noise {
    let own = own.sqrt();
    let new = Noise {
        detection_px: noise.detection_px * own,
        box_share: noise.box_share * own,
        position_m: noise.position_m * own,
        rotation_rad: noise.rotation_rad * own,
        position_segment_m: noise.position_segment_m * position.sqrt(),
        rotation_segment_rad: noise.rotation_segment_rad * rotation.sqrt(),
        ..*noise
    };
    let of_poses = |noise: &Noise| {
        [noise.position_m.hypot(noise.position_segment_m), noise.rotation_rad.hypot(noise.rotation_segment_rad)]
    };
    let ratio = |is: f64, was: f64| if was > 0.0 { is / was } else { 1.0 };
    let [position, rotation] = [0, 1].map(|part| ratio(of_poses(&new)[part], of_poses(noise)[part]));
    Noise {
        position_drift_m: noise.position_drift_m * position,
        rotation_drift_rad: noise.rotation_drift_rad * rotation,
        ..new
    }
}

/// How many looks a segment of some visits has on average: what lasts longer is the segment's error.
fn looks_of_segment(visits: &[Vec<Look>]) -> f64 {
    let looks: usize = visits.iter().map(Vec::len).sum();
    let segments: usize = visits.iter().map(|visit| segments(visit).count()).sum();
    looks as f64 / segments.max(1) as f64
}

/// The looks of each segment of a visit.
fn segments(looks: &[Look]) -> impl Iterator<Item = &[Look]> {
    drift::segments(looks, |look| look.driven_m)
}

/// Minus twice the logarithm of the restricted likelihood of the residuals of a visit, if successive looks of a segment have that correlation. Nothing if
/// numbers overflow.
fn of_remembering(looks: &[Look], correlation: f64) -> Option<f64> {
    let (mut new, mut ln_determinant) = (Vec::with_capacity(looks.len()), 0.0);
    for segment in segments(looks) {
        for (at, look) in segment.iter().enumerate() {
            let (look, ln) = look.innovation(at.checked_sub(1).map(|before| &segment[before]), correlation);
            new.push(look);
            ln_determinant += ln;
        }
    }
    Some(minus_log_likelihood(&new)?.iter().sum::<f64>() + ln_determinant)
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector, Vector3};

    use super::*;
    use crate::robust::noise::variance_of_alike;
    use crate::street;

    #[test]
    fn looks_that_are_alike_are_worth_what_their_mean_is() {
        for (looks, correlation) in [(1, 0.9), (2, 0.5), (7, 0.0), (7, 0.8), (40, 0.9)] {
            let of = DMatrix::from_fn(looks, looks, |i, k| f64::powi(correlation, i.abs_diff(k) as i32));
            let independent = of.try_inverse().map_or(f64::NAN, |inverse| inverse.sum());
            let found = variance_of_alike(looks, correlation);
            assert!((found - looks as f64 / independent).abs() < 1e-9, "{looks} {correlation} {found}");
        }
    }

    #[test]
    fn the_likelihood_of_looks_that_remember_is_that_of_one_gaussian() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let point = Vector3::new(50.0, 4.0, 3.0);
        let scene = street::street(12, 3.0, &[point], &errors);
        let visits = VisitOf::all(&scene, &street::NOISE, &(scene.usable_rays(), point)).unwrap_or_default();
        assert_eq!(visits.len(), 1);
        let looks = visits[0].looks(&scene, &street::NOISE);
        assert!(looks.len() > 8 && segments(&looks).all(|segment| segment.len() > 1) && segments(&looks).count() > 2);
        let (correlation, rows) = (0.6_f64, 2 * looks.len());
        let of_segment = |(number, looks): (usize, &[Look])| vec![number; looks.len()];
        let segment: Vec<usize> = segments(&looks).enumerate().flat_map(of_segment).collect();
        let covariance = DMatrix::from_fn(rows, rows, |a, b| {
            let (i, k) = (a / 2, b / 2);
            let variance = (looks[i].detection_px2 * looks[k].detection_px2).sqrt();
            let is_alike = a % 2 == b % 2 && segment[i] == segment[k];
            if is_alike { variance * correlation.powi(i.abs_diff(k) as i32) } else { 0.0 }
        });
        let residual = DVector::from_fn(rows, |row, _| looks[row / 2].residual[row % 2]);
        let by_point = DMatrix::from_fn(rows, 3, |row, axis| looks[row / 2].by_point[row % 2][axis]);
        let inverse = covariance.clone().try_inverse().unwrap_or_default();
        let information = by_point.transpose() * &inverse * &by_point;
        let gradient = by_point.transpose() * &inverse * &residual;
        let expected =
            residual.dot(&(&inverse * &residual)) + covariance.determinant().ln() + information.determinant().ln()
                - gradient.dot(&(information.try_inverse().unwrap_or_default() * &gradient));
        let found = of_remembering(&looks, correlation).unwrap_or(f64::NAN);
        assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        let independent: f64 = minus_log_likelihood(&looks).map_or(f64::NAN, |terms| terms.iter().sum());
        let alone = of_remembering(&looks, 0.0).unwrap_or(f64::NAN);
        assert!((alone - independent).abs() < 1e-6, "{alone} {independent}");
    }
}
