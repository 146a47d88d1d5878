//! What the images of a pass share: the drift.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::robust::energy::agreement::{Disagreement, disagreements, enough};
use crate::robust::energy::estimate::{looks_at, visits};
use crate::robust::energy::sides::{Said, at_middle, sides};
use crate::robust::energy::{Placed, Terms};
use crate::robust::noise::Noise;
use crate::robust::noise::drift::Drive;
use crate::robust::noise::told::Told;
use crate::robust::scene::Scene;

/// Where the noise is sought, how much passes of a label disagree counts up to this many standard deviations: 95 % efficient where errors are Gaussian (Huber, "Robust
/// estimation of a location parameter", 1964).
const EFFICIENT_SIGMAS: f64 = 1.345;
/// Shared errors over own errors of a pose: least and most. The mean of a hundred images has a tenth of their own errors, so that a smaller drift hardly shows.
const LEAST_DRIFT: f64 = 0.1;
/// The most: of images that are good to a millimetre from one to the next, and of a drive that is off by a metre.
const MOST_DRIFT: f64 = 1000.0;
/// Times that the interval of that ratio is cut in half: to a thousandth, far finer than it is known.
const HALVINGS: usize = 12;

/// What poses state of their errors all in all: position, m, and rotation, rad; nothing where they do not.
pub(crate) type Stated = [Option<f64>; 2];

/// What the poses of a scene state.
pub(crate) fn stated(scene: &Scene) -> Stated {
    [scene.usual(|view| view.position_sigma_m), scene.usual(|view| view.rotation_sigma_rad)]
}

/// A noise of which positions drift by a ratio to the errors of images and segments. Passes that disagree are shifted: they turn no more than their images and
/// segments do. Where poses state their errors, what images and segments do not have for themselves drifts.
pub(crate) fn drifting(noise: &Noise, ratio: f64, [position_m, rotation_rad]: Stated) -> Noise {
    let rest = |total: f64, part: f64| (total * total - part * part).max((LEAST_DRIFT * part).powi(2)).sqrt();
    let of_position = noise.position_m.hypot(noise.position_segment_m);
    let of_rotation = noise.rotation_rad.hypot(noise.rotation_segment_rad);
    Noise {
        position_drift_m: position_m.map_or(of_position * ratio, |total_m| rest(total_m, of_position)),
        rotation_drift_rad: rotation_rad.map_or(of_rotation, |total_rad| rest(total_rad, of_rotation)),
        ..*noise
    }
}

/// A noise whose images and segments have for themselves what it says, whatever poses state of their errors: what these state beyond that drifts.
pub(crate) fn as_stated(noise: &Noise, stated: Stated) -> Noise {
    let drifting = drifting(noise, 1.0, stated);
    Noise {
        position_drift_m: stated[0].map_or(noise.position_drift_m, |_| drifting.position_drift_m),
        rotation_drift_rad: stated[1].map_or(noise.rotation_drift_rad, |_| drifting.rotation_drift_rad),
        ..*noise
    }
}

/// A noise whose positions drift at least as far as was thought, m, where no objects tell how far: what all images of a drive share shows nowhere, and is
/// not small for that.
pub(crate) fn with_drift_at_least(scene: &Scene, objects: &[&Placed], noise: &Noise, thought_m: f64) -> Noise {
    let is_told = stated(scene)[0].is_some() || enough(disagreements(scene, noise, objects)).is_some();
    if is_told { *noise } else { Noise { position_drift_m: noise.position_drift_m.max(thought_m), ..*noise } }
}

/// A noise with the drift at which the passes of objects disagree as much as expected, or with that which was thought, m, if it makes what they say likelier:
/// passes of what is two objects in truth disagree whatever the drift is. An object behind one of its voters decides for the former. As large as the
/// errors of images and segments where poses state it, or nothing tells.
pub(crate) fn with_drift(scene: &Scene, objects: &[&Placed], noise: &Noise, thought_m: f64) -> Noise {
    let stated = stated(scene);
    let of = |ratio: f64| drifting(noise, ratio, stated);
    let told = stated[0].is_none().then(|| agreeing_ratio(|ratio| excess(disagreements(scene, &of(ratio), objects))));
    let Some(told) = told.flatten().map(of) else { return of(1.0) };
    let thought = Noise { position_drift_m: thought_m, ..told };
    let unlikeliness = |drifting: &Noise| -> f64 {
        let of_object =
            |object: &&Placed| minus_log_likelihood(scene, drifting, noise, object).unwrap_or(f64::INFINITY);
        // Summed in the order of the objects, so that threads do not change the result.
        objects.par_iter().map(of_object).collect::<Vec<f64>>().iter().sum()
    };
    if unlikeliness(&thought) < unlikeliness(&told) { thought } else { told }
}

/// Minus twice the logarithm of the restricted likelihood of the residuals of all visits of an object, along the lines of sight that a noise makes probable,
/// up to a constant: its position, and what the middle of each side is off by, are marginalised.
fn minus_log_likelihood(scene: &Scene, noise: &Noise, of_sight: &Noise, (votes, point): &Placed) -> Option<f64> {
    let visits: Vec<&[u32]> = visits(scene, votes).collect();
    let mut all = Terms::none();
    for side in sides(scene, visits.iter().copied()) {
        let mut of_side = Terms::none();
        for visit in side {
            let looks = looks_at(scene, noise, of_sight, visits[visit as usize], point)?;
            of_side.add_said(&Said::of(&Drive::at_one(&looks)?));
        }
        let said = of_side.said();
        let said = if noise.side_m > 0.0 { at_middle(noise.side_m, Vector3::zeros(), &said)?.0 } else { said };
        all.add_said(&said);
    }
    let told = Told::of(&all.information)?;
    Some(all.energy + told.ln_determinant() - all.gradient.dot(&told.solve(&all.gradient)))
}

/// The ratio at which nothing is in excess, by bisection of its logarithm: the larger it is, the less remains unexplained. Nothing where too little is known.
fn agreeing_ratio(excess_of: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    let (mut low, mut high) = (LEAST_DRIFT.ln(), MOST_DRIFT.ln());
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if excess_of(middle.exp())? > 0.0 { low = middle } else { high = middle }
    }
    Some((0.5 * (low + high)).exp())
}

/// By how many standard deviations disagreements are larger than expected, of most labels: Huber's psi, summed. A label of two objects disagrees
/// whatever the noise is; where a fifth of the labels are such, no drift is so large that the mean is as expected.
fn excess(of_labels: Vec<Option<Disagreement>>) -> Option<f64> {
    Some(enough(of_labels)?.iter().map(|one| one.sigmas().clamp(-EFFICIENT_SIGMAS, EFFICIENT_SIGMAS)).sum())
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use nalgebra::{Isometry3, Point3, Vector3};

    use super::*;
    use crate::robust::scene::sample::scramble;
    use crate::street;

    /// With a standard deviation of 1.
    fn uniform(number: u64) -> f64 {
        (scramble(number) as f64 / u64::MAX as f64 - 0.5) * 12.0_f64.sqrt()
    }

    /// Objects of a street and their votes from six drives, in turn from either end, to each of which they show a middle that is so far off.
    fn street_from_both_ends(off_m: f64) -> (Scene, Vec<Placed>) {
        let back = Isometry3::new(Vector3::new(300.0, 0.0, 0.0), Vector3::new(0.0, 0.0, PI));
        let objects: Vec<Vector3<f64>> = (0..24).map(|i| Vector3::new(100.0 + 20.0 * f64::from(i), 6.0, 3.0)).collect();
        let errors: Vec<[f64; 2]> = (0..997).map(|i| [uniform(2 * i), uniform(2 * i + 1)]).collect();
        let of_drive = |number: u64, drive: u64| {
            let there = if drive.is_multiple_of(2) { Isometry3::identity() } else { back };
            let off = Vector3::from_fn(|axis, _| off_m * uniform(5000 + 8 * number + 4 * (drive % 2) + axis as u64));
            let shown = there.inverse() * Point3::from(objects[number as usize] + off);
            street::moved(street::street(300, 2.0, &[shown.coords], &errors[(13 * number + drive) as usize..]), &there)
        };
        let parts = (0..24).flat_map(|number| (0..6).map(move |drive| (number, drive)));
        let mut scene = street::joined(parts.map(|(number, drive)| of_drive(number, drive)).collect());
        let mut labels: Vec<Placed> = objects.iter().map(|&object| (Vec::new(), object)).collect();
        for (ray, &image) in (0..).zip(&scene.rays.image) {
            labels[image as usize / 300 / 6].0.push(ray);
        }
        scene.views.iter_mut().for_each(|view| view.pass %= 6);
        (scene, labels)
    }

    #[test]
    fn two_objects_that_many_drives_see_tell_how_far_these_drift() {
        let objects = [Vector3::new(60.0, 6.0, 3.0), Vector3::new(75.0, -5.0, 4.0)];
        let errors: Vec<[f64; 2]> = (0..997).map(|i| [uniform(2 * i), uniform(2 * i + 1)]).collect();
        let drives = |count: u64| {
            let of_drive = |drive: u64| {
                let [x, y, z] = [0, 1, 2].map(|axis| 0.3 * uniform(9000 + 3 * drive + axis));
                street::moved(street::street(60, 2.0, &objects, &errors), &Isometry3::translation(x, y, z))
            };
            street::joined((0..count).map(of_drive).collect())
        };
        let drift_m = |count: u64| {
            let scene = drives(count);
            let mut labels: Vec<Placed> = objects.map(|object| (Vec::new(), object)).into();
            for ray in scene.usable_rays() {
                let [first, second] = objects.map(|object| scene.ray(ray).squared_error(&object));
                labels[usize::from(second < first)].0.push(ray);
            }
            let noise = Noise { position_m: 0.02, ..street::NOISE };
            with_drift(&scene, &labels.iter().collect::<Vec<_>>(), &noise, noise.position_m).position_drift_m
        };
        assert!((0.15..0.6).contains(&drift_m(6)), "{}", drift_m(6));
        assert!(drift_m(2) < 0.05, "{}", drift_m(2));
    }

    #[test]
    fn where_nothing_tells_the_drift_it_is_no_smaller_than_thought() {
        let noise = Noise { position_drift_m: 0.02, ..street::NOISE };
        let (scene, labels) = street_from_both_ends(0.0);
        let drift_m = |drives: u32, noise: &Noise| {
            let is_of = |ray: &u32| scene.view(*ray).pass < drives;
            let of_drives = |(votes, point): &Placed| (votes.iter().copied().filter(is_of).collect(), *point);
            let labels: Vec<Placed> = labels.iter().map(of_drives).collect();
            with_drift_at_least(&scene, &labels.iter().collect::<Vec<_>>(), noise, 0.1).position_drift_m
        };
        let larger = Noise { position_drift_m: 0.3, ..noise };
        for (found, expected) in [(drift_m(1, &noise), 0.1), (drift_m(6, &noise), 0.02), (drift_m(1, &larger), 0.3)] {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }

    #[test]
    fn passes_of_what_is_two_objects_are_no_drift() {
        let errors: Vec<[f64; 2]> = (0..997).map(|i| [uniform(2 * i), uniform(2 * i + 1)]).collect();
        let noise = Noise { position_m: 0.02, ..street::NOISE };
        let objects: Vec<Vector3<f64>> = (0..8).map(|i| Vector3::new(60.0 + 30.0 * f64::from(i), 6.0, 3.0)).collect();
        let drift_m = |mixed: usize, thought_m: f64| {
            // The second drive sees other objects in the place of some: a metre farther along the street.
            let elsewhere = |i: usize| Vector3::x() * if i < mixed { 1.0 } else { 0.0 };
            let of_drive = |drive: usize| {
                let there = |(i, object): (usize, &Vector3<f64>)| object + elsewhere(i) * drive as f64;
                let seen: Vec<Vector3<f64>> = objects.iter().enumerate().map(there).collect();
                let off = Isometry3::translation(0.1 * drive as f64, 0.1 * drive as f64, 0.0);
                street::moved(street::street(150, 2.0, &seen, &errors[7 * drive..]), &off)
            };
            let scene = street::joined((0..2).map(of_drive).collect());
            let mut labels: Vec<Placed> =
                objects.iter().enumerate().map(|(i, object)| (Vec::new(), object + 0.5 * elsewhere(i))).collect();
            for ray in scene.usable_rays() {
                let near = |label: &&mut Placed| scene.ray(ray).squared_error(&label.1);
                if let Some(label) = labels.iter_mut().min_by(|a, b| near(a).total_cmp(&near(b))) {
                    label.0.push(ray);
                }
            }
            with_drift(&scene, &labels.iter().collect::<Vec<_>>(), &noise, thought_m).position_drift_m
        };
        assert!((0.03..0.1).contains(&drift_m(0, 0.1)), "{}", drift_m(0, 0.1));
        // Half of them disagree whatever the drift is; what the others agree about says that it is not so large.
        assert!((drift_m(4, 0.1), drift_m(5, 0.1)) == (0.1, 0.1) && drift_m(4, 100.0) > 0.2);
    }

    #[test]
    fn what_sides_disagree_about_is_no_drift_of_their_passes() {
        let (scene, labels) = street_from_both_ends(0.2);
        // The others are seen from one end.
        let labels: Vec<&Placed> = labels[..10].iter().collect();
        let drift_m = |side_m: f64| {
            let noise = Noise { position_m: 0.02, side_m, ..street::NOISE };
            with_drift(&scene, &labels, &noise, 0.2).position_drift_m
        };
        assert!(drift_m(0.2) < 0.05, "{}", drift_m(0.2));
        assert!(drift_m(0.0) > 0.1, "{}", drift_m(0.0));
    }
}
