//! Final positions and covariances: the objects of one place are estimated together.
//!
//! Objects of one place share the pose errors of their images ([`estimate`](crate::robust::energy::estimate)). Votes that a neighbour might have
//! widen the covariance ([`contest`](super::contest)).

use nalgebra::Vector3;
use rayon::prelude::*;

use super::contest::{Contest, widened};
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::{Care, Estimate, Joint, Start};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, places_of_all};
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::parts::Part;
use crate::robust::search::exclude::{as_one, too_near};

/// Objects within this share of the range of the one with the most votes are estimated with it. In streets it is 24 m: with 15 m neighbours are missing, and
/// 40 m cost more for the same accuracy (`docs/notes/method.md`).
const PLACE_SHARE: f64 = 0.4;

/// Objects of some rays that are apart where those of a place are estimated together, with their estimates; covariances have a noise of their own. Two
/// sides of one thing, of which each drive has put its own elsewhere, are two objects until the others of the place tell the drift.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn apart(
    model: &Model<'_>,
    of_covariances: &Noise,
    lookout: &Lookout,
    mut objects: Vec<Object>,
    progress: &Progress,
) -> Result<(Vec<Object>, Vec<Estimate>), Halt> {
    loop {
        let estimates = positions(model, of_covariances, &objects, progress)?;
        let points: Vec<Vector3<f64>> = estimates.iter().map(|estimate| estimate.point).collect();
        let near = if model.settings.has(Part::Exclusion) { too_near(&objects, &points) } else { Vec::new() };
        if near.is_empty() {
            return Ok((objects, estimates));
        }
        objects = as_one(model, lookout, objects, near);
    }
}

/// The estimate of every object, in their order; covariances have a noise of their own.
fn positions(
    model: &Model<'_>,
    of_covariances: &Noise,
    objects: &[Object],
    progress: &Progress,
) -> Result<Vec<Estimate>, Halt> {
    let contest = model.settings.has(Part::Contest).then(|| Contest::new(model, objects));
    let places = places_of_all(objects, model.settings.viability.max_range_m * PLACE_SHARE);
    let estimated = |noise: &Noise, contest: Option<&Contest<'_>>| -> Result<Vec<Estimate>, Halt> {
        let mut estimates: Vec<Estimate> = objects
            .iter()
            .map(|object| Estimate { point: object.fit.point, covariance: object.fit.covariance })
            .collect();
        let of_place = |place: &Vec<usize>| {
            progress.check()?;
            Ok(together(model, noise, objects, place, contest))
        };
        // One at a time: the first ones are the largest.
        let found: Vec<Vec<(usize, Estimate)>> =
            places.par_iter().with_max_len(1).map(of_place).collect::<Result<_, Halt>>()?;
        for (i, estimate) in found.into_iter().flatten() {
            estimates[i] = estimate;
        }
        Ok(estimates)
    };
    if of_covariances == model.noise {
        return estimated(model.noise, contest.as_ref());
    }
    // Contested votes move nothing.
    let mut estimates = estimated(model.noise, None)?;
    for (estimate, honest) in estimates.iter_mut().zip(estimated(of_covariances, contest.as_ref())?) {
        estimate.covariance = honest.covariance;
    }
    Ok(estimates)
}

/// Objects that cannot be estimated together are estimated one by one. Contested votes widen their covariances, where a contest is held.
fn together(
    model: &Model<'_>,
    noise: &Noise,
    objects: &[Object],
    place: &[usize],
    contest: Option<&Contest<'_>>,
) -> Vec<(usize, Estimate)> {
    let starts = place.iter().map(|&i| Start { voters: &objects[i].votes, weights: &[], point: objects[i].fit.point });
    let Some(solution) = Joint::new(model.scene, noise, starts, Care::Exact).with_priors(model).solve() else {
        if place.len() == 1 {
            return Vec::new();
        }
        return place.iter().flat_map(|&i| together(model, noise, objects, &[i], contest)).collect();
    };
    let contested = contest.map(|contest| contest.contested(&solution)).filter(|contested| contested.contains(&true));
    let sure = contested.and_then(|contested| solution.without(&contested));
    let sure = sure.as_ref().unwrap_or(&solution.estimates);
    place.iter().zip(&solution.estimates).zip(sure).map(|((&i, found), sure)| (i, widened(found, sure))).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::*;
    use crate::robust::energy::estimate::looks_at;
    use crate::robust::energy::object;
    use crate::robust::model::heights::Heights;
    use crate::robust::noise::variance_of_alike;
    use crate::robust::parts::Without;
    use crate::robust::settings::Settings;
    use crate::street;

    fn estimates_of(model: &Model<'_>, of_covariances: &Noise, objects: &[Object]) -> Vec<Estimate> {
        positions(model, of_covariances, objects, &Progress::default()).unwrap_or_default()
    }

    #[test]
    fn looks_that_are_off_alike_say_less_of_positions_and_move_none() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let point = Vector3::new(48.0, 5.0, 3.0);
        // Images at 0 to 34 m: three segments of six.
        let scene = street::street(18, 2.0, &[point], &errors);
        let votes = scene.usable_rays();
        assert_eq!(votes.len(), 18);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let found: Vec<Object> = object(&model, &lookout, votes.clone(), point).into_iter().collect();
        assert_eq!(found.len(), 1);
        let alike = Noise { look_correlation: 0.8, ..street::NOISE };
        let times = variance_of_alike(6, 0.8);
        let [before, after] = [&street::NOISE, &alike].map(|noise| estimates_of(&model, noise, &found)[0]);
        assert_eq!(before.point, after.point);
        assert!((after.covariance - before.covariance * times).norm() < 0.01 * after.covariance.norm());
        let looks = |noise| looks_at(&scene, noise, noise, &votes, &point).unwrap_or_default();
        for (before, after) in looks(&street::NOISE).iter().zip(looks(&alike)) {
            assert!((after.detection_px2 / before.detection_px2 - times).abs() < 1e-9);
        }
    }

    #[test]
    fn what_each_of_two_drives_has_put_elsewhere_is_one_where_neighbours_tell_the_drift() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let objects: Vec<Vector3<f64>> =
            (0..8).map(|i| Vector3::new(40.0 + f64::from(i), 2.5 * f64::from(i - 4), 3.0)).collect();
        let off = Vector3::new(0.0, 0.4, 0.0);
        let drive = || street::street(12, 2.0, &objects, &errors);
        let scene = street::joined(vec![drive(), street::moved(drive(), &Translation3::from(off).into())]);
        let noise = Noise { position_drift_m: 0.3, ..street::NOISE };
        let apart_of = |settings: &Settings, twice: usize| {
            let model = Model::new(&scene, &noise, settings);
            let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
            let rays = scene.usable_rays();
            let of = |i: usize| rays.iter().copied().skip(i).step_by(objects.len());
            let seen_by = |i: usize, pass: u32| of(i).filter(|&ray| scene.view(ray).pass == pass).collect();
            let object = |votes, point| object(&model, &lookout, votes, point);
            let drives = |i: usize| [object(seen_by(i, 0), objects[i]), object(seen_by(i, 1), objects[i] + off)];
            let of_drives = (0..twice).flat_map(drives);
            let found = of_drives.chain((twice..8).map(|i| object(of(i).collect(), objects[i] + 0.5 * off)));
            let found: Vec<Object> = found.flatten().collect();
            let points: Vec<Vector3<f64>> = found.iter().map(|object| object.fit.point).collect();
            assert_eq!((found.len(), too_near(&found, &points).len()), (8 + twice, 0));
            apart(&model, &noise, &lookout, found, &Progress::default())
        };
        let count = |settings: &Settings, twice: usize| {
            let (found, estimates) = apart_of(settings, twice).unwrap_or_default();
            assert_eq!(found.len(), estimates.len());
            found.len()
        };
        assert_eq!(count(&street::SETTINGS, 1), 8);
        let without = Without::named(&["exclusion".to_owned()]).unwrap_or_default();
        assert_eq!(count(&Settings { without, ..street::SETTINGS }, 1), 9);
        // Where no neighbour is seen by both drives, nothing tells that they are off.
        assert_eq!(count(&street::SETTINGS, 8), 16);
    }

    #[test]
    fn heights_tell_how_far_objects_are_but_not_how_high_the_cameras_were() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let objects: Vec<Vector3<f64>> =
            (0..10).map(|i| Vector3::new(30.0 + f64::from(i), f64::from(i - 5), 3.0)).collect();
        let scene = street::street(4, 2.0, &objects, &errors);
        let noise = Noise { position_drift_m: 0.2, ..street::NOISE };
        let mut model = Model::new(&scene, &noise, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let votes = |i: usize| scene.usable_rays().into_iter().skip(i).step_by(objects.len()).collect();
        let found: Vec<Object> = (0..10).filter_map(|i| object(&model, &lookout, votes(i), objects[i])).collect();
        assert_eq!(found.len(), objects.len());
        let without = estimates_of(&model, &noise, &found);
        let heights: Vec<f64> = (0..60).map(|i| 3.0 + 0.01 * f64::from(i % 5 - 2)).collect();
        model.classes[0].heights = Heights::learn(&heights, &[0.02; 60], 50.0);
        let with = estimates_of(&model, &noise, &found);
        let sigma_m = |estimate: &Estimate, axis: usize| estimate.covariance[(axis, axis)].sqrt();
        // Those that are not begun near their height are taken for objects that are elsewhere.
        let told = with.iter().zip(&without).filter(|(with, without)| sigma_m(with, 0) < 0.5 * sigma_m(without, 0));
        assert!(told.count() >= 7);
        // All cameras may be 0.2 m higher or lower than is said, and all objects with them.
        assert!(with.iter().all(|with| sigma_m(with, 2) > 0.19));
    }
}
