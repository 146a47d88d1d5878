//! Hypotheses, bounded: each ray meets few partners, and proposes the meeting that a sample of the images supports best.

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::index::chi2;
use super::model::{Model, Sizes};
use super::noise::Spread;
use super::sample::{Sampler, level_of, scramble};
use super::scene::Scene;
use crate::ballot::ones;
use crate::kernel::{Gates, LANES};
use crate::progress::{Halt, Progress};
use crate::ray::Ray;

/// Images around an image among which partners are sought and votes are sampled, at most.
const SAMPLE_IMAGES: usize = 40;
/// Meetings that a ray is tried with, at most.
const MEETINGS: usize = 24;
/// So many images within the range of an image are enough to propose what they see.
const PROPOSING_IMAGES: usize = 80;
/// Images that look from farther aside than this should not all have seen a point (cosine of 30 degrees).
const ASIDE_COSINE: f64 = 0.866;

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
            let around = sampler.around(image, 0.0, SAMPLE_IMAGES);
            let neighborhood = Neighborhood::new(model, image, &around, &|other| by_image.rays(other));
            Ok(by_image.rays(image).iter().filter_map(|&ray| neighborhood.best_meeting(ray)).collect())
        })
        .collect::<Result<Vec<_>, Halt>>()?;
    Ok(proposed.into_iter().flatten().collect())
}

/// What some proposers say, with some rays alone as partners.
#[must_use]
pub fn propose_among(model: &Model<'_>, rays: &[u32], proposers: &[u32]) -> Vec<Hypothesis> {
    let image_of = |ray: u32| model.scene.rays.image[ray as usize];
    let mut images: Vec<u32> = rays.iter().map(|&ray| image_of(ray)).collect();
    images.dedup();
    images.sort_by_cached_key(|&image| scramble(u64::from(image)));
    let stride = images.len().div_ceil(2 * SAMPLE_IMAGES).max(1);
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
        let image_of = |ray: u32| scene.rays.image[ray as usize] as usize;
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
            partners,
            gates,
        }
    }

    fn best_meeting(&self, ray: u32) -> Option<Hypothesis> {
        let own = Partner::new(self.model, ray, 0, &self.origin);
        let sizes = &self.model.class_of(ray).sizes;
        let meetings = self.partners.iter().filter_map(|other| self.meet(&own, other, sizes));
        let meetings: Vec<Meeting> = meetings.take(MEETINGS).collect();
        let points: Vec<Vector3<f64>> = meetings.iter().map(|meeting| meeting.point).collect();
        let words = self.gates.words();
        let (mut maybe, mut sure) = (vec![0; points.len() * words], vec![0; points.len() * words]);
        self.gates.test(&points, &mut maybe, &mut sure);
        let mut best: Option<(f64, usize)> = None;
        for (i, meeting) in meetings.iter().enumerate() {
            let (votes, support) = self.support(&own, meeting, &maybe[i * words..(i + 1) * words]);
            if votes >= 2 && best.is_none_or(|(most, _)| support > most) {
                best = Some((support, i));
            }
        }
        best.map(|(support, i)| Hypothesis {
            point: points[i] + self.origin,
            rays: [ray, meetings[i].partner],
            support,
        })
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
        let viability = &self.model.settings.viability;
        let in_range = |&r: &f64| r >= viability.min_range_m && r <= viability.max_range_m;
        if !ranges.iter().all(in_range) {
            return None;
        }
        let [of_own, of_other] = [own.ln_angle + ranges[0].ln(), other.ln_angle + ranges[1].ln()];
        if !sizes.agree(of_own, of_other, self.model.settings.gate_sigmas) {
            return None;
        }
        let on_own = own.ray.center + own.ray.direction * ranges[0];
        let on_other = other.ray.center + other.ray.direction * ranges[1];
        let [own_m2, other_m2] = [own.variance_m2(ranges[0]), other.variance_m2(ranges[1])];
        let point = on_own + (on_other - on_own) * (own_m2 / (own_m2 + other_m2));
        let fits = own.chi2(&point) < self.gate_chi2 && other.chi2(&point) < self.gate_chi2;
        fits.then_some(Meeting { point, partner: other.number, ln_size: 0.5 * (of_own + of_other) })
    }

    /// Images of the sample with a ray in whose gate the point lies, and how much more probable that makes it; what should have seen it and
    /// did not, makes it less so.
    fn support(&self, own: &Partner, meeting: &Meeting, maybe: &[u64]) -> (u32, f64) {
        let rates = self.model.class_of(own.number).rates;
        let mut gains = vec![f64::NEG_INFINITY; self.images.len()];
        for (word, &maybe) in maybe.iter().enumerate() {
            for bit in ones(maybe) {
                let partner = &self.partners[word * LANES + bit as usize];
                let projected = partner.ray.project(&meeting.point);
                let chi2 = chi2(&projected, &partner.spread);
                if partner.class != own.class || !(projected.z > 0.0 && chi2 < self.gate_chi2) {
                    continue;
                }
                let variance = partner.spread.variance(projected.z);
                let gain = self.model.vote_gain(
                    own.class,
                    partner.number,
                    chi2,
                    variance * variance,
                    projected.z,
                    meeting.ln_size,
                );
                let best = &mut gains[partner.place as usize];
                *best = best.max(gain);
            }
        }
        let scene = self.model.scene;
        let to_point = meeting.point - own.ray.center;
        let farthest = self.images.iter().zip(&gains).filter(|(_, gain)| **gain > 0.0);
        let distance = |image: u32| (scene.views[image as usize].center - self.origin - meeting.point).norm();
        let farthest = farthest.map(|(&image, _)| distance(image)).fold(to_point.norm(), f64::max);
        let (mut votes, mut support) = (0, self.model.ln_range_ratio(own.number, own.ray.project(&meeting.point).z));
        for (&image, &gain) in self.images.iter().zip(&gains).filter(|(image, _)| **image != own.image) {
            if gain > 0.0 {
                votes += 1;
                support += gain + rates.log_miss();
                continue;
            }
            let view = &scene.views[image as usize];
            let away = meeting.point - (view.center - self.origin);
            let length = away.norm();
            let should = length <= farthest
                && away.dot(&to_point) >= ASIDE_COSINE * length * to_point.norm()
                && scene.is_in_picture(view, &(meeting.point + self.origin));
            if should {
                support += rates.log_miss();
            }
        }
        (votes, support)
    }
}
