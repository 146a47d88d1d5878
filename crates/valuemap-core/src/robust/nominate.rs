//! Candidates, bounded: each ray meets few partners, and nominates the meeting that a sample of the images supports best.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::index::chi2;
use super::noise::Spread;
use super::sample::{Sampler, level_of};
use super::scene::Scene;
use crate::ballot::ones;
use crate::hypothesis::Viability;
use crate::kernel::{Gates, LANES};
use crate::progress::{Halt, Progress};
use crate::ray::Ray;

/// Images around an image among which partners are sought and votes are sampled, at most.
const SAMPLE_IMAGES: usize = 40;
/// Meetings that a ray is tried with, at most.
const MEETINGS: usize = 12;
/// Cameras nearer to each other than this make no pair, m.
const MIN_BASELINE_M: f64 = 0.5;

/// So many images within the range of an image are enough to nominate what they see.
const NOMINATING_IMAGES: usize = 80;

/// Which images nominate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Who {
    /// All images with free rays.
    All,
    /// A random part of them: those of the highest level that has enough around most images.
    Part,
}

/// A point that a ray speaks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nomination {
    /// The point in the world, m.
    pub point: Vector3<f64>,
    /// The ray, and the partner it met.
    pub rays: [u32; 2],
    /// How many images of the sample support the point, and how well.
    pub support: f64,
}

/// Let free rays nominate a point each, if any is supported by a third image: all of them, or those of a part of the images
/// where there are many.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn nominate(
    scene: &Scene,
    spreads: &[Spread],
    gate_sigmas: f64,
    viability: &Viability,
    free: &[u32],
    who: Who,
    progress: &Progress,
) -> Result<Vec<Nomination>, Halt> {
    let centers: Vec<Vector3<f64>> = scene.views.iter().map(|view| view.center).collect();
    let by_image = ByImage::new(scene, free);
    let images = by_image.images();
    let sampler = Sampler::new(&centers, &images, viability.max_range_m);
    let level = match who {
        Who::All => 0,
        Who::Part => sampler.level_with(NOMINATING_IMAGES),
    };
    let nominated = images
        .par_iter()
        .map(|&image| {
            progress.advance()?;
            if level_of(image) < level {
                return Ok(Vec::new());
            }
            let partners = sampler.around(image, MIN_BASELINE_M, SAMPLE_IMAGES);
            let partners = partners.iter().flat_map(|&other| by_image.rays(other)).copied();
            let booth = Booth::new(scene, spreads, gate_sigmas, viability, image, partners);
            Ok(by_image.rays(image).iter().filter_map(|&ray| booth.best_meeting(ray)).collect())
        })
        .collect::<Result<Vec<_>, Halt>>()?;
    Ok(nominated.into_iter().flatten().collect())
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
struct Booth<'a> {
    scene: &'a Scene,
    spreads: &'a [Spread],
    limit: f64,
    viability: &'a Viability,
    max_cosine: f64,
    origin: Vector3<f64>,
    partners: Vec<Party>,
    gates: Gates,
}

/// A ray with what decides where it meets others: a copy in a world around the booth, so that what belongs together
/// lies together.
struct Party {
    number: u32,
    image: u32,
    class: u32,
    ray: Ray,
    spread: Spread,
    /// Square metres across the ray that a squared pixel spans at a depth of 1 m.
    unit_per_px2: f64,
}

impl Party {
    fn new(scene: &Scene, spreads: &[Spread], ray: u32, origin: &Vector3<f64>) -> Self {
        let row = ray as usize;
        Self {
            number: ray,
            image: scene.rays.image[row],
            class: scene.rays.class[row],
            ray: scene.ray(ray).relative_to(origin),
            spread: spreads[row],
            unit_per_px2: scene.scale2[row].recip(),
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

impl<'a> Booth<'a> {
    fn new(
        scene: &'a Scene,
        spreads: &'a [Spread],
        gate_sigmas: f64,
        viability: &'a Viability,
        image: u32,
        partners: impl Iterator<Item = u32>,
    ) -> Self {
        let origin = scene.views[image as usize].center;
        let partners: Vec<Party> = partners.map(|ray| Party::new(scene, spreads, ray, &origin)).collect();
        let gates =
            Gates::new((0..).zip(&partners).map(|(lane, party)| (lane, &party.ray, party.spread.gate(gate_sigmas))));
        Self {
            scene,
            spreads,
            limit: gate_sigmas * gate_sigmas,
            viability,
            max_cosine: viability.min_parallax_rad.cos(),
            origin,
            partners,
            gates,
        }
    }

    fn best_meeting(&self, ray: u32) -> Option<Nomination> {
        let own = Party::new(self.scene, self.spreads, ray, &self.origin);
        let meetings = self.partners.iter().filter_map(|other| Some((self.meet(&own, other)?, other.number)));
        let (points, met): (Vec<Vector3<f64>>, Vec<u32>) = meetings.take(MEETINGS).unzip();
        let words = self.gates.words();
        let (mut maybe, mut sure) = (vec![0; points.len() * words], vec![0; points.len() * words]);
        self.gates.test(&points, &mut maybe, &mut sure);
        let mut best: Option<(f64, usize)> = None;
        for (i, point) in points.iter().enumerate() {
            let (votes, support) = self.support(own.class, point, &maybe[i * words..(i + 1) * words]);
            if votes >= 2 && best.is_none_or(|(most, _)| support > most) {
                best = Some((support, i));
            }
        }
        best.map(|(support, i)| Nomination { point: points[i] + self.origin, rays: [ray, met[i]], support })
    }

    /// Where two rays meet, if it lies in the gates of both.
    ///
    /// The point between the nearest points of the two lines that is as many of its sigmas from each: to first order the
    /// one of least correction.
    fn meet(&self, own: &Party, other: &Party) -> Option<Vector3<f64>> {
        let cosine = own.ray.direction.dot(&other.ray.direction);
        if own.class != other.class || !(cosine < self.max_cosine) {
            return None;
        }
        let baseline = other.ray.center - own.ray.center;
        let (along_own, along_other) = (baseline.dot(&own.ray.direction), baseline.dot(&other.ray.direction));
        let scale = 1.0 / (1.0 - cosine * cosine);
        let ranges = [(along_own - cosine * along_other) * scale, (cosine * along_own - along_other) * scale];
        let in_range = |&r: &f64| r >= self.viability.min_range_m && r <= self.viability.max_range_m;
        if !ranges.iter().all(in_range) {
            return None;
        }
        let on_own = own.ray.center + own.ray.direction * ranges[0];
        let on_other = other.ray.center + other.ray.direction * ranges[1];
        let [of_own, of_other] = [own.variance_m2(ranges[0]), other.variance_m2(ranges[1])];
        let point = on_own + (on_other - on_own) * (of_own / (of_own + of_other));
        (own.chi2(&point) < self.limit && other.chi2(&point) < self.limit).then_some(point)
    }

    /// Images of the sample with a ray in whose gate the point lies, and how well: 1 for each image, less the squared
    /// residual of its closest ray as a share of the gate.
    fn support(&self, class: u32, point: &Vector3<f64>, maybe: &[u64]) -> (u32, f64) {
        let (mut votes, mut support) = (0, 0.0);
        let (mut last, mut of_last) = (u32::MAX, 0.0);
        for (word, &maybe) in maybe.iter().enumerate() {
            for bit in ones(maybe) {
                let partner = &self.partners[word * LANES + bit as usize];
                let fit = 1.0 - partner.chi2(point) / self.limit;
                if partner.class != class || !(fit > 0.0) {
                    continue;
                }
                if partner.image == last {
                    support += (fit - of_last).max(0.0);
                    of_last = of_last.max(fit);
                } else {
                    votes += 1;
                    support += fit;
                    (last, of_last) = (partner.image, fit);
                }
            }
        }
        (votes, support)
    }
}
