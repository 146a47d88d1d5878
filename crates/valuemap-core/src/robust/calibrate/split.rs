//! Split of the noise between poses and detections, by what the objects of an image have in common.
//!
//! At one object alone the two cannot be told apart: an error of position moves a box by `f / depth`, and so does an error that
//! grows with the box of an object of one size; a rotation is as good as an error in pixels. But a pose moves all objects of an
//! image alike, and each detection is off by itself. So the two shares make the residuals of all objects of a place together
//! likeliest (restricted maximum likelihood, positions and drift marginalised). The noise in all stays as large as it is,
//! but for the drift, which follows from the share of the poses.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::AKAIKE;
use super::residuals::{self, BOX_SHARE, detection_px};
use super::shared::{stated, with_drift};
use crate::robust::energy::estimate::is_one_visit;
use crate::robust::energy::{Object, placed, places_of_all};
use crate::robust::model::{Model, median};
use crate::robust::noise::drift::{Drive, Look, Normals, Vantage};
use crate::robust::noise::huber::huber_weight;
use crate::robust::noise::{Known, Noise};

/// Votes that serve, about: of a thousand images that show several objects each, a share is known to a few hundredths.
const SAMPLE_VOTES: usize = 5_000;
/// Shares are tried in so many steps first. What lies between two of them is within reach of the halvings that follow.
const STEPS: usize = 5;
/// Then so many times on both sides of the best, each time in steps half as long: to a hundredth, as shares are known to a few.
const HALVINGS: usize = 4;
/// The two shares are sought in turn, so many times. Each is sought once with the other as it was, and once with what was found of the other.
const TURNS: usize = 2;
/// The share of the pose is no less than this, and no more than 1 less this: no noise is no density. A smaller one is not told from it: shares are known to a
/// few hundredths.
const LEAST_SHARE: f64 = 0.02;

/// Objects of one place, with what their votes see.
struct Place {
    /// Object of the place and ray of each vote, by pass and image.
    votes: Vec<(usize, u32)>,
    weights: Vec<f64>,
    points: Vec<Vector3<f64>>,
}

/// The noise of a model with the shares of pose and detection that the objects of images tell; `known` parts stay as they are.
#[must_use]
pub fn split(model: &Model<'_>, known: Known, objects: &[Object]) -> Noise {
    let (noise, scene) = (*model.noise, model.scene);
    // Where poses state their errors, the shares of these are known as well.
    if known.detection || stated(scene).iter().any(Option::is_some) {
        return noise;
    }
    let places = sample(model, objects);
    let Some(scale) = Scale::of(model, &places) else { return noise };
    let value = |noise: &Noise| -> f64 {
        // Summed in the order of the places, so that threads do not change the result.
        let each: Vec<Option<f64>> = places.par_iter().map(|place| place.minus_log_likelihood(model, noise)).collect();
        each.iter().map(|value| value.unwrap_or(f64::INFINITY)).sum()
    };
    let (least_px, _) = detection_px(known);
    let before = value(&noise);
    let mut best = (before, noise);
    for _ in 0..TURNS {
        if !known.position {
            best = least(best, scale.least_of_position(&noise), &|share| scale.with_position(&best.1, share), &value);
        }
        if !known.rotation {
            best = least(best, LEAST_SHARE, &|share| scale.with_rotation(&best.1, share, least_px), &value);
        }
    }
    // What two parameters gain by chance tells no shares.
    if before - best.0 > 2.0 * AKAIKE { redrifted(model, objects, &best.1) } else { noise }
}

/// The noise with its drift told anew: the one before followed from poses that turned by more, or less.
fn redrifted(model: &Model<'_>, objects: &[Object], noise: &Noise) -> Noise {
    let labels = placed(objects);
    with_drift(model.scene, &residuals::sample(model.scene, noise, &labels), noise, noise.position_drift_m)
}

/// The noise with the least value among those of shares from `lowest` on, or the one that is the best so far.
fn least(
    mut best: (f64, Noise),
    lowest: f64,
    noise_of: &dyn Fn(f64) -> Noise,
    value: &dyn Fn(&Noise) -> f64,
) -> (f64, Noise) {
    let highest = 1.0 - LEAST_SHARE;
    let mut at = None;
    let mut attempt = |share: f64, at: &mut Option<f64>| {
        let noise = noise_of(share);
        let found = value(&noise);
        if found < best.0 {
            (best, *at) = ((found, noise), Some(share));
        }
    };
    let step = (highest - lowest) / STEPS as f64;
    for i in 0..=STEPS {
        attempt(lowest + step * i as f64, &mut at);
    }
    let mut reach = 0.5 * step;
    for _ in 0..HALVINGS {
        let Some(middle) = at else { break };
        for share in [middle - reach, middle + reach] {
            if (lowest..=highest).contains(&share) {
                attempt(share, &mut at);
            }
        }
        reach *= 0.5;
    }
    best
}

/// What turns pixels into metres and radians.
struct Scale {
    /// Mean squared focal length, px².
    px2: f64,
    /// Median size of objects, m.
    size_m: f64,
}

impl Scale {
    /// That of the votes of some places; nothing if there are none.
    fn of(model: &Model<'_>, places: &[Place]) -> Option<Self> {
        let votes =
            || places.iter().flat_map(|place| place.votes.iter().map(|&(label, ray)| (place.points[label], ray)));
        let mut sizes: Vec<f64> = votes()
            .map(|(point, ray)| {
                let depth_m = model.scene.ray(ray).project(&point).z;
                model.scene.box_px[ray as usize] * depth_m / model.scene.scale2[ray as usize].sqrt()
            })
            .filter(|size| size.is_finite() && *size > 0.0)
            .collect();
        let size_m = median(&mut sizes)?;
        let px2 = votes().map(|(_, ray)| model.scene.scale2[ray as usize]).sum::<f64>() / votes().count() as f64;
        Some(Self { px2, size_m })
    }

    /// What grows as objects come near, m².
    fn near_m2(&self, noise: &Noise) -> f64 {
        noise.position_m.powi(2) + (noise.box_share * self.size_m).powi(2)
    }

    /// The least share of it that may be the position's: a detector is not off by more than so much of its boxes.
    fn least_of_position(&self, noise: &Noise) -> f64 {
        LEAST_SHARE.max(1.0 - (BOX_SHARE.1 * self.size_m).powi(2) / self.near_m2(noise))
    }

    /// Noise of which the position has a share of what grows as objects come near.
    fn with_position(&self, noise: &Noise, share: f64) -> Noise {
        let near_m2 = self.near_m2(noise);
        Noise {
            position_m: (share * near_m2).sqrt(),
            box_share: ((1.0 - share) * near_m2).sqrt() / self.size_m,
            ..*noise
        }
    }

    /// Noise of which the rotation has a share of what does not, and detections at least so much, px.
    fn with_rotation(&self, noise: &Noise, share: f64, least_px: f64) -> Noise {
        let far_px2 = noise.detection_px.powi(2) + self.px2 * noise.rotation_rad.powi(2);
        Noise {
            detection_px: ((1.0 - share) * far_px2).sqrt().max(least_px),
            rotation_rad: (share * far_px2 / self.px2).sqrt(),
            ..*noise
        }
    }
}

/// Places of which images show several objects, every so many of them.
fn sample(model: &Model<'_>, objects: &[Object]) -> Vec<Place> {
    let places = places_of_all(objects, model.settings.viability.max_range_m);
    let votes = |place: &Vec<usize>| place.iter().map(|&i| objects[i].votes.len()).sum::<usize>();
    let several: Vec<&Vec<usize>> = places.iter().filter(|place| place.len() > 1).collect();
    let every = several.iter().map(|place| votes(place)).sum::<usize>().div_ceil(SAMPLE_VOTES).max(1);
    let of = |place: &Vec<usize>| Place::of(model, objects, place);
    let served = several.into_iter().step_by(every).map(of);
    served.filter(|place| place.minus_log_likelihood(model, model.noise).is_some()).collect()
}

impl Place {
    fn of(model: &Model<'_>, objects: &[Object], members: &[usize]) -> Self {
        let mut counted: Vec<((usize, u32), f64)> = Vec::new();
        for (label, &i) in members.iter().enumerate() {
            let weight = |chi2: &f64| huber_weight(*chi2);
            counted.extend(
                objects[i].votes.iter().zip(&objects[i].fit.chi2).map(|(&ray, chi2)| ((label, ray), weight(chi2))),
            );
        }
        counted.sort_by_key(|&((label, ray), _)| (model.scene.view(ray).pass, ray, label));
        let (votes, weights) = counted.into_iter().unzip();
        Self { votes, weights, points: members.iter().map(|&i| objects[i].fit.point).collect() }
    }

    /// Minus twice the logarithm of the restricted likelihood of all residuals together, up to a constant; nothing where numbers overflow or the
    /// votes fix no position.
    fn minus_log_likelihood(&self, model: &Model<'_>, noise: &Noise) -> Option<f64> {
        let scene = model.scene;
        let mut looks: Vec<Look> = Vec::with_capacity(self.votes.len());
        for &(label, ray) in &self.votes {
            let vantage = Vantage::of(scene, noise, ray).with_sight_of(scene, model.noise, ray);
            looks.push(vantage.look(label, &self.points[label])?);
        }
        let mut all = Normals::nothing(self.points.len());
        let mut value = 0.0;
        let mut first = 0;
        for visit in self.votes.chunk_by(|a, b| is_one_visit(scene.view(a.1), scene.view(b.1))) {
            let of_visit = first..first + visit.len();
            let drive = Drive::along(&looks[of_visit.clone()], &self.weights[of_visit], self.points.len())?;
            all.information += &drive.normals.information;
            all.gradient += &drive.normals.gradient;
            value += drive.normals.square + drive.log_determinant();
            first += visit.len();
        }
        let cholesky = all.information.cholesky()?;
        value += 2.0 * cholesky.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        Some(value - all.gradient.dot(&cholesky.solve(&all.gradient)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn detections_keep_the_noise_of_their_rounding_whatever_share_the_rotation_has() {
        let scale = Scale { px2: 1e6, size_m: 0.3 };
        let noise = Noise {
            detection_px: 1.0,
            box_share: 0.05,
            position_m: 0.1,
            rotation_rad: 1e-3,
            position_segment_m: 0.0,
            rotation_segment_rad: 0.0,
            position_drift_m: 0.0,
            rotation_drift_rad: 0.0,
            side_m: 0.0,
            look_correlation: 0.0,
        };
        let of = |least_px| scale.with_rotation(&noise, 0.98, least_px);
        assert!(of(0.0).detection_px < 0.21 && of(0.5).detection_px.to_bits() == 0.5_f64.to_bits());
        assert!((of(0.5).rotation_rad - (0.98_f64 * 2.0).sqrt() * 1e-3).abs() < 1e-9);
    }
}
