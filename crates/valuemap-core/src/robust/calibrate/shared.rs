//! What the images of a pass and those of a side share: the drift, and the middles that sides show.

use rayon::prelude::*;

use crate::robust::energy::agreement::{Disagreement, MIN_SHARED_LABELS, disagreements, sides_of_all};
use crate::robust::energy::estimate::Care;
use crate::robust::energy::{Placed, SURE_VOTES, implied_size};
use crate::robust::learn::median;
use crate::robust::model::Model;
use crate::robust::noise::{Known, Noise};
use crate::robust::scene::Scene;

/// Where the noise is sought, how much passes of a label disagree counts up to this many standard deviations: 95 % efficient where errors are Gaussian (Huber, "Robust
/// estimation of a location parameter", 1964).
const HUBER_SIGMAS: f64 = 1.345;
/// Shared errors over own errors of a pose: least and most.
const LEAST_DRIFT: f64 = 0.1;
const MOST_DRIFT: f64 = 1000.0;
/// Sides of labels that disagree by fewer standard deviations than this more than expected, all together, agree: as chance has it in 98 cases of 100.
const SUSPECTED_SIGMAS: f64 = 2.0;
/// By more than this they do not: chance has it in one case of a thousand.
const CERTAIN_SIGMAS: f64 = 3.0;
/// Middles are sought down to this share of the usual size: less is an error of the detector, if it is one.
const LEAST_SHARE: f64 = 1e-3;
/// Times that an interval is cut in half where a value is sought: to a thousandth.
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

/// A noise with the drift of positions of which nothing is in excess: the larger it is taken for, the less remains unexplained. Nothing where poses state it, or
/// too little is known.
fn agreeing_drift(noise: &Noise, stated: Stated, excess_of: impl Fn(&Noise) -> Option<f64>) -> Option<Noise> {
    if stated[0].is_some() {
        return None;
    }
    let of = |ratio: f64| drifting(noise, ratio, stated);
    agreeing(LEAST_DRIFT, MOST_DRIFT, |ratio| excess_of(&of(ratio))).map(of)
}

/// A noise with the drift at which the passes of objects disagree as much as expected; as large as the errors of images and segments where nothing tells.
pub(crate) fn with_drift(scene: &Scene, objects: &[&Placed], noise: &Noise) -> Noise {
    let stated = stated(scene);
    let excess_of = |noise: &Noise| excess(disagreements(scene, noise, objects).into_iter());
    agreeing_drift(noise, stated, excess_of).unwrap_or_else(|| drifting(noise, 1.0, stated))
}

/// The value between two of which nothing is in excess: by bisection of its logarithm, of what falls with it. Nothing where too little is known.
fn agreeing(low: f64, high: f64, excess_of: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    let (mut low, mut high) = (low.ln(), high.ln());
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if excess_of(middle.exp())? > 0.0 { low = middle } else { high = middle }
    }
    Some((0.5 * (low + high)).exp())
}

/// By how many standard deviations disagreements are larger than expected, of most labels: Huber's psi, summed. A label of two objects disagrees
/// whatever the noise is; where a fifth of the labels are such, no drift is so large that the mean is as expected.
fn excess(of_labels: impl Iterator<Item = Option<Disagreement>>) -> Option<f64> {
    let known: Vec<f64> = of_labels.flatten().map(|one| one.sigmas().clamp(-HUBER_SIGMAS, HUBER_SIGMAS)).collect();
    (known.len() >= MIN_SHARED_LABELS).then(|| known.iter().sum())
}

/// The noise of a model with the error of the middles that sides of some labels show, and with the drift that is left for their passes; nothing where
/// sides agree as far as the passes of one side do, or where nothing has a size: middles are those of boxes.
#[must_use]
pub(crate) fn with_sides(model: &Model<'_>, known: Known, labels: &[Placed]) -> Option<Noise> {
    let labels: Vec<&Placed> = labels.iter().filter(|label| label.0.len() >= SURE_VOTES).collect();
    noise_of_sides(model, known, &labels, Care::Rough, SUSPECTED_SIGMAS)
}

/// The same beyond doubt: of labels that stand alone, as one of two neighbours may have what the other shows to a side, and as exactly as labels are
/// estimated in the end, as sides that are seen often differ by what a rough estimate is off by.
#[must_use]
pub(crate) fn with_sides_for_sure(model: &Model<'_>, known: Known, labels: &[Placed]) -> Option<Noise> {
    let stands_alone = |(votes, point): &Placed| {
        let off_m = |&ray: &u32| {
            let depth_m = model.scene.ray(ray).project(point).z;
            depth_m * (model.spreads[ray as usize].variance(depth_m) / model.scene.scale2[ray as usize]).sqrt()
        };
        let near_m = model.settings.gate_sigmas * votes.iter().map(off_m).fold(0.0, f64::max);
        labels.iter().filter(|other| (other.1 - point).norm() < near_m).count() == 1
    };
    let alone: Vec<&Placed> =
        labels.par_iter().filter(|label| label.0.len() >= SURE_VOTES && stands_alone(label)).collect();
    noise_of_sides(model, known, &alone, Care::Exact, CERTAIN_SIGMAS)
}

fn noise_of_sides(model: &Model<'_>, known: Known, labels: &[&Placed], care: Care, least_sigmas: f64) -> Option<Noise> {
    let (scene, noise) = (model.scene, model.noise);
    let size_m = usual_size_m(model, labels)?;
    let of_one_side = |noise: &Noise| {
        let sides = sides_of_all(scene, noise, labels, Care::Rough);
        excess(sides.iter().map(|sides| sides.as_ref()?.within()))
    };
    let drifted = if known.position { None } else { agreeing_drift(noise, stated(scene), of_one_side) };
    let of_passes = drifted.unwrap_or(*noise);
    let sides = sides_of_all(scene, &of_passes, labels, care);
    let between = |side_m: f64| sides.iter().map(move |sides| sides.as_ref()?.between(side_m));
    let count = between(0.0).flatten().count() as f64;
    if excess(between(0.0))? < least_sigmas * count.sqrt() {
        return None;
    }
    let side_m = agreeing(LEAST_SHARE * size_m, size_m, |side_m| excess(between(side_m)))?;
    Some(Noise { side_m, ..of_passes })
}

/// The median size that boxes of some labels imply, m; nothing if there are none.
fn usual_size_m(model: &Model<'_>, labels: &[&Placed]) -> Option<f64> {
    let sizes = labels.iter().flat_map(|(votes, point)| votes.iter().map(|&ray| implied_size(model, ray, point)));
    median(&mut sizes.filter(|size| size.is_finite()).collect::<Vec<f64>>()).map(f64::exp)
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

    /// Objects of a street, so far apart, and their votes from six drives, in turn from either end, to each of which they show a middle that is so
    /// far off.
    fn street_from_both_ends(apart_m: f64, off_m: f64) -> (Scene, Vec<Placed>) {
        let back = Isometry3::new(Vector3::new(300.0, 0.0, 0.0), Vector3::new(0.0, 0.0, PI));
        let objects: Vec<Vector3<f64>> =
            (0..24).map(|i| Vector3::new(100.0 + apart_m * f64::from(i), 6.0, 3.0)).collect();
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
    fn middles_of_sides_are_learned_where_there_are_any() {
        let noise = Noise { position_drift_m: 0.03, ..street::NOISE };
        for (off_m, is_found) in [(0.2, true), (0.0, false)] {
            let (scene, labels) = street_from_both_ends(20.0, off_m);
            let model = Model::new(&scene, &noise, &street::SETTINGS);
            for found in [with_sides, with_sides_for_sure].map(|learn| learn(&model, Known::default(), &labels)) {
                assert_eq!(found.is_some(), is_found, "{found:?}");
                let side_m = found.map_or(off_m, |found| found.side_m);
                assert!((0.7 * off_m..=1.3 * off_m).contains(&side_m), "{side_m}");
            }
        }
    }

    #[test]
    fn neighbours_do_not_tell_for_sure_whether_sides_show_other_middles() {
        let noise = Noise { position_drift_m: 0.03, ..street::NOISE };
        let (scene, labels) = street_from_both_ends(0.3, 0.2);
        let model = Model::new(&scene, &noise, &street::SETTINGS);
        assert!(with_sides(&model, Known::default(), &labels).is_some());
        assert_eq!(with_sides_for_sure(&model, Known::default(), &labels), None);
    }

    #[test]
    fn nothing_without_a_size_shows_other_middles() {
        let noise = Noise { position_drift_m: 0.03, ..street::NOISE };
        let (mut scene, labels) = street_from_both_ends(20.0, 0.2);
        scene.box_px.fill(0.0);
        let model = Model::new(&scene, &noise, &street::SETTINGS);
        assert_eq!(with_sides(&model, Known::default(), &labels), None);
    }

    #[test]
    fn what_sides_disagree_about_is_no_drift_of_their_passes() {
        let noise = Noise { position_drift_m: 0.2, ..street::NOISE };
        let (scene, labels) = street_from_both_ends(20.0, 0.2);
        let model = Model::new(&scene, &noise, &street::SETTINGS);
        let found = with_sides(&model, Known::default(), &labels);
        assert!(found.is_some_and(|found| found.position_drift_m < 0.05), "{found:?}");
    }
}
