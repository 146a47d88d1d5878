//! Self-calibration: the noise is estimated from the residuals of the labels by restricted maximum likelihood.
//!
//! Positions are marginalised, so that they take no freedom from the noise. Depth tells errors of position from those in pixels,
//! and box size tells the part that grows with the box. Residuals of one focal length do not tell rotation from detection: each
//! gets half, until images that show several objects tell ([`split`](mod@super::split)). The error that a pass shares shows only
//! where passes meet: it makes the positions that each pass alone would give a label differ as much as they do
//! ([`shared`](super::shared)). Errors of this kind are the C of equation (1) of `docs/method.md`.

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::shared::{drifting, stated, with_drift};
use crate::robust::energy::estimate::{looks_at, visits};
use crate::robust::energy::{LEAST_VOTES, Placed, SURE_VOTES};
use crate::robust::model::FALSE_SHARE;
use crate::robust::noise::drift::{Drive, Look};
use crate::robust::noise::told::Told;
use crate::robust::noise::{Known, Noise};
use crate::robust::scene::Scene;

/// If labels with so many voters have fewer than this together, those with at least `LEAST_VOTES` serve: a standard deviation is known to a
/// tenth from fifty squares, each of the five that are sought.
const ENOUGH_VOTES: usize = 250;
/// A visit with fewer voters has no residuals.
const MIN_VOTES_OF_VISIT: usize = 2;
/// Voters that are used, about. It bounds the work: by the reckoning above, a standard deviation is known to a fiftieth from so many.
const SAMPLE_VOTES: usize = 6000;
/// The parameters are searched between these factors of a step, from coarse to fine. Each is about the root of the one before. The last is finer than a
/// standard deviation is known from the fewest voters that serve.
const STEPS: [f64; 5] = [2.0, 1.5, 1.25, 1.12, 1.06];
/// The part of the variance of distant objects' residuals that is taken for rotation. Residuals of one focal length do not tell it from detection, so each has
/// half until images that show several objects tell (`split`).
const ROTATION_PART: f64 = 0.5;
/// The part of the variance of what the images of a segment share that each of them has for itself all the same: errors that forget 63 % of
/// themselves along a segment differ by twice this between images that are a tenth of a segment apart, as viewpoints are (Ornstein-Uhlenbeck).
const ROUGHNESS: f64 = 0.1;
/// What is searched for, and where: least and most. No detector is exact to a twentieth of a pixel, and where 30 px were reached nothing was found
/// (`docs/notes/method.md`).
const DETECTION_PX: (f64, f64) = (0.05, 30.0);
/// Boxes of objects of one size grow as errors of position do, with one over the distance: a detector that is off by more than this share of its boxes is not
/// one, what is more is the position's. The least is a tenth of a pixel of a box of 100 px.
pub(crate) const BOX_SHARE: (f64, f64) = (1e-3, 0.15);
/// Of positions, m: no survey is so exact as the least, and poses of a car are off by some metres.
const POSITION_M: (f64, f64) = (1e-4, 5.0);

/// Within what the noise of detections is, px.
pub(crate) fn detection_px(known: Known) -> (f64, f64) {
    (DETECTION_PX.0.max(known.least_px).min(DETECTION_PX.1), DETECTION_PX.1)
}

/// Estimate the noise, starting from a guess.
///
/// The guess is returned where there are too few labels to tell.
#[must_use]
pub fn calibrate(scene: &Scene, guess: &Noise, labels: &[Placed], known: Known) -> Noise {
    let sample = sample(scene, guess, labels);
    if sample.len() < 3 {
        return *guess;
    }
    let visits_of = |label: &&Placed| VisitOf::all(scene, guess, label);
    let visits: Vec<Option<Vec<VisitOf>>> = sample.par_iter().map(visits_of).collect();
    let scale2 = sample.iter().flat_map(|object| &object.0).map(|&ray| scene.scale2[ray as usize]);
    let scale2 = scale2.sum::<f64>() / sample.iter().map(|object| object.0.len()).sum::<usize>() as f64;
    // What is rotation of an image alone and what is its detections', residuals of one focal length do not tell.
    let (known_px2, known_rad2) = (guess.detection_px.powi(2), guess.rotation_rad.powi(2));
    let (least_px, most_px) = detection_px(known);
    let far_of = |px2: f64| match (known.detection, known.rotation) {
        (true, true) => (guess.detection_px, guess.rotation_rad),
        (true, false) => (guess.detection_px, ((px2 - known_px2).max(0.0) / scale2).sqrt()),
        (false, true) => ((px2 - scale2 * known_rad2).max(least_px.powi(2)).sqrt(), guess.rotation_rad),
        (false, false) => (((1.0 - ROTATION_PART) * px2).sqrt(), (ROTATION_PART * px2 / scale2).sqrt()),
    };
    let stated = stated(scene);
    let noise_of = |p: &[f64; 5]| {
        let [position_segment_m, rotation_segment_rad] = [p[3], p[4]];
        // What images of a segment share is not quite the same for all of them.
        let rough = |of_segment: f64| if of_segment > 0.0 { ROUGHNESS * of_segment * of_segment } else { 0.0 };
        let (detection_px, rotation_rad) = far_of(p[0] * p[0] + scale2 * rough(rotation_segment_rad));
        let position_m = if known.position { p[2] } else { (p[2] * p[2] + rough(position_segment_m)).sqrt() };
        let own = Noise {
            detection_px,
            box_share: p[1],
            position_m,
            rotation_rad,
            position_segment_m,
            rotation_segment_rad,
            ..*guess
        };
        drifting(&own, 1.0, stated)
    };
    let fixed = [known.detection && known.rotation, known.detection, known.position, known.position, known.rotation];
    let start = [
        (known_px2 + scale2 * known_rad2).sqrt(),
        guess.box_share,
        guess.position_m,
        guess.position_segment_m,
        guess.rotation_segment_rad,
    ];
    let rotation_rad = (DETECTION_PX.0 / scale2.sqrt(), DETECTION_PX.1 / scale2.sqrt());
    let found = search(start, [(least_px, most_px), BOX_SHARE, POSITION_M, POSITION_M, rotation_rad], fixed, &|p| {
        let noise = noise_of(p);
        let of_label = |visits: &Option<Vec<VisitOf>>| {
            let all = visits.iter().flatten().map(|visit| visit.minus_log_likelihood(scene, &noise));
            all.collect::<Option<Vec<[f64; 3]>>>().map_or(0.0, |terms| terms.iter().flatten().sum())
        };
        // Summed in the order of the labels, so that threads do not change the result.
        visits.par_iter().with_max_len(1).map(of_label).collect::<Vec<f64>>().iter().sum()
    });
    with_drift(scene, &sample, &noise_of(&found), guess.position_drift_m)
}

/// Minimise a cost over positive parameters by a pattern search in their logarithms, with a prior around the start.
pub(crate) fn search<const N: usize>(
    start: [f64; N],
    bounds: [(f64, f64); N],
    fixed: [bool; N],
    cost: &dyn Fn(&[f64; N]) -> f64,
) -> [f64; N] {
    let mut best = start;
    for i in (0..N).filter(|&i| !fixed[i]) {
        best[i] = best[i].clamp(bounds[i].0, bounds[i].1);
    }
    let center = best;
    // The start is trusted to a factor of e (standard deviation of the logarithm): what the data do not tell stays near it.
    let of = |parameters: &[f64; N]| {
        let away = (0..N).filter(|&i| !fixed[i]).map(|i| (parameters[i] / center[i]).ln());
        cost(parameters) + away.map(|away| away * away).sum::<f64>()
    };
    // Where a round of all parameters changed none of them, the next one tries the same.
    let mut known: FxHashMap<[u64; N], f64> = FxHashMap::default();
    let mut penalised =
        |parameters: &[f64; N]| *known.entry(parameters.map(f64::to_bits)).or_insert_with(|| of(parameters));
    let mut least = penalised(&best);
    for step in STEPS {
        for i in (0..N).chain(0..N).filter(|&i| !fixed[i]) {
            for factor in [step, 1.0 / step] {
                loop {
                    let mut trial = best;
                    trial[i] = (best[i] * factor).clamp(bounds[i].0, bounds[i].1);
                    if trial[i].to_bits() == best[i].to_bits() {
                        break;
                    }
                    let value = penalised(&trial);
                    if !(value < least) {
                        break;
                    }
                    (best, least) = (trial, value);
                }
            }
        }
    }
    best
}

/// Well supported labels, evenly over the map, together about as many voters as needed. Those whose residuals fit the
/// guess worst are left out, as many as are false: wrong associations would be taken for noise.
pub(crate) fn sample<'a>(scene: &Scene, guess: &Noise, labels: &'a [Placed]) -> Vec<&'a Placed> {
    let votes: usize = labels.iter().map(|label| label.0.len()).filter(|&votes| votes >= SURE_VOTES).sum();
    let least = if votes < ENOUGH_VOTES { LEAST_VOTES } else { SURE_VOTES };
    let mut good: Vec<(f64, &Placed)> = labels
        .iter()
        .filter(|label| label.0.len() >= least)
        .map(|label| (misfit(scene, guess, label), label))
        .collect();
    let mut misfits: Vec<f64> = good.iter().map(|(misfit, _)| *misfit).collect();
    misfits.sort_by(f64::total_cmp);
    if let Some(&limit) = misfits.get((misfits.len() as f64 * (1.0 - FALSE_SHARE)) as usize) {
        good.retain(|(misfit, _)| *misfit <= limit);
    }
    let good: Vec<&Placed> = good.into_iter().map(|(_, label)| label).collect();
    let votes: usize = good.iter().map(|label| label.0.len()).sum();
    let stride = (votes / SAMPLE_VOTES).max(1);
    good.into_iter().step_by(stride).collect()
}

/// Squared residuals of a label in sigmas, shared errors taken out, a residual.
fn misfit(scene: &Scene, noise: &Noise, label: &Placed) -> f64 {
    let passes = visits(scene, &label.0);
    let of_pass = |pass| Some(Drive::at_one(&looks_at(scene, noise, noise, pass, &label.1)?)?.normals.square);
    passes.filter_map(of_pass).sum::<f64>() / label.0.len() as f64
}

/// A visit of a label: what stays the same of its looks while the noise is sought, with ray and depth, m.
pub(crate) struct VisitOf(Vec<(u32, f64, Look)>);

impl VisitOf {
    /// The visits of a label along the lines of sight that a noise makes probable; nothing if the label is behind a voter.
    pub(crate) fn all(scene: &Scene, of_sight: &Noise, (votes, point): &Placed) -> Option<Vec<Self>> {
        let of_visit = |visit: &[u32]| {
            let looks = looks_at(scene, of_sight, of_sight, visit, point)?;
            let depths_m = visit.iter().map(|&ray| scene.ray(ray).project(point).z);
            Some(Self(visit.iter().copied().zip(depths_m).zip(looks).map(|((ray, m), look)| (ray, m, look)).collect()))
        };
        visits(scene, votes).filter(|visit| visit.len() >= MIN_VOTES_OF_VISIT).map(of_visit).collect()
    }

    /// Its looks with another noise.
    pub(crate) fn looks(&self, scene: &Scene, noise: &Noise) -> Vec<Look> {
        self.0.iter().map(|(ray, depth_m, look)| look.with_noise(scene, noise, *ray, *depth_m)).collect()
    }

    fn minus_log_likelihood(&self, scene: &Scene, noise: &Noise) -> Option<[f64; 3]> {
        minus_log_likelihood(&self.looks(scene, noise))
    }
}

/// Minus twice the logarithm of the restricted likelihood of the residuals of a visit, up to a constant, in three terms: each visit may
/// put the object elsewhere, so that what visits disagree about is not taken for errors within them. Nothing if numbers overflow.
pub(crate) fn minus_log_likelihood(looks: &[Look]) -> Option<[f64; 3]> {
    let drive = Drive::at_one(looks)?;
    let (information, gradient) = drive.normals.of_one();
    let told = Told::of(&information)?;
    Some([drive.normals.square + drive.log_determinant(), told.ln_determinant(), -gradient.dot(&told.solve(&gradient))])
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use nalgebra::Vector3;

    use super::*;
    use crate::street;

    #[test]
    fn looks_with_another_noise_are_those_that_would_be_had_with_it() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let point = Vector3::new(30.0, 4.0, 3.0);
        let scene = street::joined((0..3).map(|i| street::street(10, 2.0, &[point], &errors[7 * i..])).collect());
        let noise =
            Noise { detection_px: 2.5, position_segment_m: 0.02, ..street::NOISE.scaled(1.7, Known::default()) };
        let placed = (scene.usable_rays(), point);
        let visits = VisitOf::all(&scene, &street::NOISE, &placed).unwrap_or_default();
        assert_eq!(visits.len(), 3);
        for (VisitOf(looks), votes) in visits.iter().zip(self::visits(&scene, &placed.0)) {
            let again: Vec<Look> =
                looks.iter().map(|(ray, depth_m, look)| look.with_noise(&scene, &noise, *ray, *depth_m)).collect();
            assert_eq!(Some(again), looks_at(&scene, &noise, &street::NOISE, votes, &point));
        }
    }

    #[test]
    fn the_least_cost_is_found_and_nothing_is_tried_twice() {
        let tried: RefCell<Vec<[u64; 2]>> = RefCell::default();
        let cost = |p: &[f64; 2]| {
            tried.borrow_mut().push(p.map(f64::to_bits));
            1e6 * ((p[0] / 3.0).ln().powi(2) + (p[1] * p[0] / 2.0).ln().powi(2))
        };
        let found = search([1.0, 1.0], [(0.01, 100.0); 2], [false; 2], &cost);
        assert!((found[0] - 3.0).abs() < 0.1 && (found[1] - 2.0 / 3.0).abs() < 0.05, "{found:?}");
        let mut tried = tried.into_inner();
        let count = tried.len();
        tried.sort_unstable();
        tried.dedup();
        assert_eq!(tried.len(), count);
    }
}
