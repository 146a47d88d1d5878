//! Final positions and covariances: the objects of one place are estimated together.
//!
//! Objects of one place share the pose errors of their images ([`estimate`](super::estimate)). Votes that a neighbour might have
//! widen the covariance ([`contest`](super::contest)).

use rayon::prelude::*;

use super::contest::{Contest, widened};
use super::energy::{Object, by_place};
use super::estimate::{Care, Estimate, Joint, Start};
use super::model::Model;
use super::parts::Part;

/// Objects within this share of the range of the one with the most votes are estimated with it.
const PLACE_SHARE: f64 = 0.4;
/// Objects that are estimated together, at most: the cost grows with the square of their number.
const MOST_OBJECTS: usize = 12;

/// The estimate of every object, in their order.
#[must_use]
pub fn finish(model: &Model<'_>, objects: &[Object]) -> Vec<Estimate> {
    let contest = Contest::new(model, objects);
    let mut estimates: Vec<Estimate> =
        objects.iter().map(|object| Estimate { point: object.fit.point, covariance: object.fit.covariance }).collect();
    let places = places(objects, model.settings.viability.max_range_m * PLACE_SHARE);
    // One at a time: the first ones are the largest.
    let found: Vec<Vec<(usize, Estimate)>> =
        places.par_iter().with_max_len(1).map(|place| together(model, objects, place, &contest)).collect();
    for (i, estimate) in found.into_iter().flatten() {
        estimates[i] = estimate;
    }
    estimates
}

/// Objects that cannot be estimated together are estimated one by one.
fn together(model: &Model<'_>, objects: &[Object], place: &[usize], contest: &Contest<'_>) -> Vec<(usize, Estimate)> {
    let starts = place.iter().map(|&i| Start { voters: &objects[i].votes, weights: &[], point: objects[i].fit.point });
    let Some(solution) = Joint::new(model.scene, model.noise, starts, Care::Exact).with_priors(model).solve() else {
        if place.len() == 1 {
            return Vec::new();
        }
        return place.iter().flat_map(|&i| together(model, objects, &[i], contest)).collect();
    };
    let contested = contest.contested(&solution);
    let is_contested = contested.contains(&true) && model.settings.has(Part::Contest);
    let sure = is_contested.then(|| solution.without(&contested)).flatten();
    let sure = sure.as_ref().unwrap_or(&solution.estimates);
    place.iter().zip(&solution.estimates).zip(sure).map(|((&i, found), sure)| (i, widened(found, sure))).collect()
}

/// The objects around those with the most votes, each object in one place.
pub(super) fn places(objects: &[Object], radius_m: f64) -> Vec<Vec<usize>> {
    let tree = by_place(objects);
    let mut order: Vec<usize> = (0..objects.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(objects[i].votes.len()), i));
    let mut taken = vec![false; objects.len()];
    let mut places = Vec::new();
    for middle in order {
        if taken[middle] {
            continue;
        }
        let near = tree.nearest_neighbor_iter_with_distance_2(objects[middle].fit.point.into());
        let near = near.take_while(|(_, distance2)| *distance2 <= radius_m * radius_m).map(|(near, _)| near.data);
        let mut place: Vec<usize> = near.filter(|&i| !taken[i]).take(MOST_OBJECTS).collect();
        place.sort_unstable();
        for &i in &place {
            taken[i] = true;
        }
        places.push(place);
    }
    places
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::energy::object;
    use super::super::heights::Heights;
    use super::super::looks::Lookout;
    use super::super::noise::Noise;
    use super::*;
    use crate::street;

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
        let found: Vec<Object> =
            (0..10).filter_map(|i| object(&model, &lookout, votes(i), objects[i], Vec::new())).collect();
        assert_eq!(found.len(), objects.len());
        let without = finish(&model, &found);
        let heights: Vec<f64> = (0..60).map(|i| 3.0 + 0.01 * f64::from(i % 5 - 2)).collect();
        model.classes[0].heights = Heights::learn(&heights, &[0.02; 60], 50.0);
        let with = finish(&model, &found);
        let sigma_m = |estimate: &Estimate, axis: usize| estimate.covariance[(axis, axis)].sqrt();
        // Those that are not begun near their height are taken for objects that are elsewhere.
        let told = with.iter().zip(&without).filter(|(with, without)| sigma_m(with, 0) < 0.5 * sigma_m(without, 0));
        assert!(told.count() >= 7);
        // All cameras may be 0.2 m higher or lower than is said, and all objects with them.
        assert!(with.iter().all(|with| sigma_m(with, 2) > 0.19));
    }
}
