//! Hypotheses, bounded: each ray meets few partners and proposes the point that a sample of the images supports best.
//!
//! All pairs of rays would be quadratic in the number of passes; with a fixed number of partners the work per image is constant.

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::kernel::{Gates, LANES, ones};
use crate::progress::{Halt, Progress};
use crate::ray::Ray;
use crate::robust::energy::ONE_SIDE_COSINE;
use crate::robust::model::{Model, Sizes, VotesFor};
use crate::robust::noise::Spread;
use crate::robust::noise::index::chi2;
use crate::robust::scene::Scene;
use crate::robust::scene::sample::{Sampler, level_of, scramble};

/// Images around an image among which partners are sought and votes are sampled, at most. It bounds the work for an image, however many passes there are: each
/// meeting is tried on all of them.
const SAMPLE_IMAGES: usize = 40;
/// Meetings that a ray is tried with, at most. It bounds the work for a ray. They come in random order, so that with fewer the right one is missed more often.
pub const MEETINGS: usize = 24;
/// So many images within the range of an image are enough to propose what they see. Of what is left over then, all images propose.
const PROPOSING_IMAGES: usize = 2 * SAMPLE_IMAGES;

/// Which images propose.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Who {
    /// All images with free rays.
    All,
    /// A random part of them: those of the highest level that has enough around most images.
    Part,
}

/// A point that a ray speaks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// The point in the world, m.
    pub point: Vector3<f64>,
    /// The ray, and the partner it met.
    pub rays: [u32; 2],
    /// How much more probable it is than nothing, in logarithms, by the images of the sample.
    pub support: f64,
}

/// Let free rays propose a point each, if any is supported by a third image: all of them, or those of a part of the images
/// where there are many.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn propose(model: &Model<'_>, free: &[u32], who: Who, progress: &Progress) -> Result<Vec<Hypothesis>, Halt> {
    let scene = model.scene;
    let centers: Vec<Vector3<f64>> = scene.views.iter().map(|view| view.center).collect();
    let by_image = ByImage::new(scene, free);
    let images = by_image.images();
    let sampler = Sampler::new(&centers, &images, model.settings.viability.max_range_m);
    let level = match who {
        Who::All => 0,
        Who::Part => sampler.level_with(PROPOSING_IMAGES),
    };
    let proposed = images
        .par_iter()
        .map(|&image| {
            progress.check()?;
            if level_of(image) < level {
                return Ok(Vec::new());
            }
            let around = sampler.around(image, SAMPLE_IMAGES);
            let neighborhood = Neighborhood::new(model, image, &around, &|other| by_image.rays(other));
            Ok(by_image.rays(image).iter().filter_map(|&ray| neighborhood.best_meeting(ray)).collect())
        })
        .collect::<Result<Vec<_>, Halt>>()?;
    Ok(proposed.into_iter().flatten().collect())
}

/// What some proposers say, with some rays alone as partners.
#[must_use]
pub fn propose_among(model: &Model<'_>, rays: &[u32], proposers: &[u32]) -> Vec<Hypothesis> {
    let image_of = |ray: u32| model.scene.image_of(ray);
    let mut images: Vec<u32> = rays.iter().map(|&ray| image_of(ray)).collect();
    images.dedup();
    images.sort_by_cached_key(|&image| scramble(u64::from(image)));
    let stride = images.len().div_ceil(PROPOSING_IMAGES).max(1);
    let images: Vec<u32> = images.into_iter().step_by(stride).collect();
    let mut chosen: FxHashMap<u32, Vec<u32>> = FxHashMap::default();
    for &ray in rays.iter().filter(|&&ray| model.scene.ray(ray).is_usable()) {
        chosen.entry(image_of(ray)).or_default().push(ray);
    }
    let Some(&first) = images.first() else { return Vec::new() };
    let of_image = |image: u32| chosen.get(&image).map_or(&[][..], Vec::as_slice);
    let neighborhood = Neighborhood::new(model, first, &images, &of_image);
    proposers
        .iter()
        .filter(|&&ray| model.scene.ray(ray).is_usable())
        .filter_map(|&ray| neighborhood.best_meeting(ray))
        .collect()
}

/// The free rays of every image, one image after the other.
struct ByImage {
    starts: Vec<u32>,
    rays: Vec<u32>,
}

impl ByImage {
    fn new(scene: &Scene, free: &[u32]) -> Self {
        let usable = || free.iter().copied().filter(|&ray| scene.ray(ray).is_usable());
        let image_of = |ray: u32| scene.image_of(ray) as usize;
        let mut starts = vec![0_u32; scene.views.len() + 1];
        for ray in usable() {
            starts[image_of(ray) + 1] += 1;
        }
        for image in 0..scene.views.len() {
            starts[image + 1] += starts[image];
        }
        let mut next = starts.clone();
        let mut rays = vec![0; starts[scene.views.len()] as usize];
        for ray in usable() {
            let place = &mut next[image_of(ray)];
            rays[*place as usize] = ray;
            *place += 1;
        }
        Self { starts, rays }
    }

    fn rays(&self, image: u32) -> &[u32] {
        &self.rays[self.starts[image as usize] as usize..self.starts[image as usize + 1] as usize]
    }

    /// Images with free rays, ascending.
    fn images(&self) -> Vec<u32> {
        (0..self.starts.len() as u32 - 1).filter(|&image| !self.rays(image).is_empty()).collect()
    }
}

/// The rays of a sample of images around one image.
struct Neighborhood<'a> {
    model: &'a Model<'a>,
    gate_chi2: f64,
    max_cosine: f64,
    origin: Vector3<f64>,
    images: &'a [u32],
    /// Where each of them was taken, from the origin, m.
    centers: Vec<Vector3<f64>>,
    partners: Vec<Partner>,
    gates: Gates,
}

/// A ray with what decides where it meets others: a copy in a world around the neighborhood, so that what belongs together
/// lies together.
struct Partner {
    number: u32,
    image: u32,
    /// The place of its image in the sample.
    place: u32,
    class: u32,
    ray: Ray,
    spread: Spread,
    ln_angle: f64,
    /// Square metres across the ray that a squared pixel spans at a depth of 1 m.
    unit_per_px2: f64,
}

impl Partner {
    fn new(model: &Model<'_>, ray: u32, place: usize, origin: &Vector3<f64>) -> Self {
        let row = ray as usize;
        Self {
            number: ray,
            image: model.scene.rays.image[row],
            place: place as u32,
            class: model.scene.rays.class[row],
            ray: model.scene.ray(ray).relative_to(origin),
            spread: model.spreads[row],
            ln_angle: model.ln_angle[row],
            unit_per_px2: model.scene.scale2[row].recip(),
        }
    }

    /// Variance across the ray at a distance, m².
    fn variance_m2(&self, distance: f64) -> f64 {
        (self.spread.far_px2 * distance * distance + self.spread.near_px2) * self.unit_per_px2
    }

    /// Squared residual of a point over its variance; infinite behind the camera.
    fn chi2(&self, point: &Vector3<f64>) -> f64 {
        let projected = self.ray.project(point);
        if projected.z > 0.0 { chi2(&projected, &self.spread) } else { f64::INFINITY }
    }
}

/// A place where two rays meet.
struct Meeting {
    point: Vector3<f64>,
    partner: u32,
    ln_size: f64,
}

impl<'a> Neighborhood<'a> {
    fn new<'r>(model: &'a Model<'a>, image: u32, images: &'a [u32], rays_of: &dyn Fn(u32) -> &'r [u32]) -> Self {
        let origin = model.scene.views[image as usize].center;
        let rays =
            images.iter().enumerate().flat_map(|(place, &other)| rays_of(other).iter().map(move |&ray| (place, ray)));
        let partners: Vec<Partner> = rays.map(|(place, ray)| Partner::new(model, ray, place, &origin)).collect();
        let gate_sigmas = model.settings.gate_sigmas;
        let gates = Gates::new(
            (0..).zip(&partners).map(|(lane, partner)| (lane, &partner.ray, partner.spread.gate(gate_sigmas))),
        );
        Self {
            model,
            gate_chi2: gate_sigmas * gate_sigmas,
            max_cosine: model.settings.viability.min_parallax_rad.cos(),
            origin,
            images,
            centers: images.iter().map(|&image| model.scene.views[image as usize].center - origin).collect(),
            partners,
            gates,
        }
    }

    fn best_meeting(&self, ray: u32) -> Option<Hypothesis> {
        let own = Partner::new(self.model, ray, 0, &self.origin);
        let meetings = self.meetings(&own);
        let points: Vec<Vector3<f64>> = meetings.iter().map(|meeting| meeting.point).collect();
        let words = self.gates.words();
        let mut maybe = vec![0; points.len() * words];
        self.gates.test_maybe(&points, &mut maybe);
        let votes_for = self.model.votes_for(own.class);
        let mut best: Option<(f64, usize)> = None;
        let mut gains = Vec::with_capacity(self.images.len());
        for (i, meeting) in meetings.iter().enumerate() {
            self.gains(&own, &votes_for, meeting, &maybe[i * words..(i + 1) * words], &mut gains);
            let (votes, at_most) = self.votes(&own, meeting, &gains);
            // Who should have seen it and did not makes no meeting more probable, and takes long to find.
            if votes < 2 || best.is_some_and(|(most, _)| !(at_most > most)) {
                continue;
            }
            let support = self.support(&own, meeting, &gains);
            if best.is_none_or(|(most, _)| support > most) {
                best = Some((support, i));
            }
        }
        best.map(|(support, i)| Hypothesis {
            point: points[i] + self.origin,
            rays: [ray, meetings[i].partner],
            support,
        })
    }

    /// Where a ray meets others, the first of them.
    fn meetings(&self, own: &Partner) -> Vec<Meeting> {
        let sizes = &self.model.class_of(own.number).sizes;
        self.partners.iter().filter_map(|other| self.meet(own, other, sizes)).take(MEETINGS).collect()
    }

    /// Where two rays meet, if it lies in the gates of both and their boxes may be of one size there.
    ///
    /// The point between the nearest points of the two lines that is as many of its sigmas from each: to first order the
    /// one of least correction.
    fn meet(&self, own: &Partner, other: &Partner, sizes: &Sizes) -> Option<Meeting> {
        let cosine = own.ray.direction.dot(&other.ray.direction);
        if own.class != other.class || own.image == other.image || !(cosine < self.max_cosine) {
            return None;
        }
        let baseline = other.ray.center - own.ray.center;
        let (along_own, along_other) = (baseline.dot(&own.ray.direction), baseline.dot(&other.ray.direction));
        let scale = 1.0 / (1.0 - cosine * cosine);
        let ranges = [(along_own - cosine * along_other) * scale, (cosine * along_own - along_other) * scale];
        let (nearest_m, reach_m) = (self.model.settings.viability.min_range_m, self.model.reach_m());
        let in_range = |&r: &f64| r >= nearest_m && r <= reach_m;
        if !ranges.iter().all(in_range) {
            return None;
        }
        let on_own = own.ray.center + own.ray.direction * ranges[0];
        let on_other = other.ray.center + other.ray.direction * ranges[1];
        let [own_m2, other_m2] = [own.variance_m2(ranges[0]), other.variance_m2(ranges[1])];
        let point = on_own + (on_other - on_own) * (own_m2 / (own_m2 + other_m2));
        if !(own.chi2(&point) < self.gate_chi2 && other.chi2(&point) < self.gate_chi2) {
            return None;
        }
        // Last, since logarithms take longer than all that.
        let [of_own, of_other] = [own.ln_angle + ranges[0].ln(), other.ln_angle + ranges[1].ln()];
        let agree = sizes.agree(of_own, of_other, self.model.settings.gate_sigmas);
        agree.then_some(Meeting { point, partner: other.number, ln_size: 0.5 * (of_own + of_other) })
    }

    /// Set `gains` to what each image of the sample gains by a meeting: that of its best ray in whose gate the point lies; of none less than nothing.
    fn gains(&self, own: &Partner, votes_for: &VotesFor<'_>, meeting: &Meeting, maybe: &[u64], gains: &mut Vec<f64>) {
        gains.clear();
        gains.resize(self.images.len(), f64::NEG_INFINITY);
        for (word, &maybe) in maybe.iter().enumerate() {
            for bit in ones(maybe) {
                let partner = &self.partners[word * LANES + bit as usize];
                let projected = partner.ray.project(&meeting.point);
                let chi2 = chi2(&projected, &partner.spread);
                if partner.class != own.class || !(projected.z > 0.0 && chi2 < self.gate_chi2) {
                    continue;
                }
                let variance = partner.spread.variance(projected.z);
                let gain = votes_for.gain(partner.number, chi2, variance * variance, projected.z, meeting.ln_size);
                let best = &mut gains[partner.place as usize];
                *best = best.max(gain);
            }
        }
    }

    /// Images of the sample that gain by a meeting, and how much more probable that makes it, whoever else should have seen it.
    fn votes(&self, own: &Partner, meeting: &Meeting, gains: &[f64]) -> (u32, f64) {
        let log_miss = self.model.class_of(own.number).rates.log_miss();
        let (mut votes, mut support) = (0, self.support_of_range(own, meeting));
        for (_, gain) in self.images.iter().zip(gains).filter(|(image, gain)| **image != own.image && **gain > 0.0) {
            votes += 1;
            support += gain + log_miss;
        }
        (votes, support)
    }

    /// How much more probable the measured range of a ray makes a meeting.
    fn support_of_range(&self, own: &Partner, meeting: &Meeting) -> f64 {
        self.model.ln_range_ratio(own.number, own.ray.project(&meeting.point).z)
    }

    /// How much more probable the images of the sample make a meeting: those that gain by it, and those that should have seen it and did not. It is no
    /// more than [`votes`](Self::votes) say, rounding and all: what is added besides, in the same order, is negative.
    fn support(&self, own: &Partner, meeting: &Meeting, gains: &[f64]) -> f64 {
        let log_miss = self.model.class_of(own.number).rates.log_miss();
        let scene = self.model.scene;
        let to_point = meeting.point - own.ray.center;
        let range = to_point.norm();
        let farthest = self.centers.iter().zip(gains).filter(|(_, gain)| **gain > 0.0);
        let farthest = farthest.map(|(center, _)| (center - meeting.point).norm()).fold(range, f64::max);
        let mut support = self.support_of_range(own, meeting);
        for ((&image, center), &gain) in self.images.iter().zip(&self.centers).zip(gains) {
            if image == own.image {
                continue;
            }
            if gain > 0.0 {
                support += gain + log_miss;
                continue;
            }
            let away = meeting.point - center;
            let length = away.norm();
            // Images that look from farther aside should not all have seen it.
            let should = length <= farthest
                && away.dot(&to_point) >= ONE_SIDE_COSINE * length * range
                && scene.is_in_picture(&scene.views[image as usize], &(meeting.point + self.origin));
            if should {
                support += log_miss;
            }
        }
        support
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street;

    #[test]
    fn the_best_meeting_is_the_first_of_those_with_most_support_of_all() {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let all = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(31.0, 4.6, 3.2), Vector3::new(24.0, -5.0, 4.0)];
        let scene = street::joined((0..4).map(|i| street::street(10, 2.0, &all, &errors[7 * i..])).collect());
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let rays = scene.usable_rays();
        let by_image = ByImage::new(&scene, &rays);
        let images: Vec<u32> = (0..scene.views.len() as u32).collect();
        let neighborhood = Neighborhood::new(&model, 0, &images, &|image| by_image.rays(image));
        // All partners are asked, whatever the gates say.
        let mut everybody = vec![0; neighborhood.gates.words()];
        (0..neighborhood.partners.len()).for_each(|lane| everybody[lane / LANES] |= 1 << (lane % LANES));
        let (mut found, mut pruned) = (0, 0);
        for ray in rays {
            let own = Partner::new(&model, ray, 0, &neighborhood.origin);
            let votes_for = model.votes_for(own.class);
            let mut best: Option<(f64, Vector3<f64>)> = None;
            for meeting in neighborhood.meetings(&own) {
                let mut gains = Vec::new();
                neighborhood.gains(&own, &votes_for, &meeting, &everybody, &mut gains);
                let (votes, at_most) = neighborhood.votes(&own, &meeting, &gains);
                let support = neighborhood.support(&own, &meeting, &gains);
                assert!(support <= at_most);
                pruned += usize::from(support < at_most);
                if votes >= 2 && best.is_none_or(|(most, _)| support > most) {
                    best = Some((support, meeting.point + neighborhood.origin));
                }
            }
            let quick = neighborhood.best_meeting(ray).map(|best| (best.support, best.point));
            assert_eq!(quick, best);
            found += usize::from(best.is_some());
        }
        assert!(found > 60 && pruned > 0, "{found} {pruned}");
    }
}
