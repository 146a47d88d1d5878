//! Candidates, bounded: each ray meets few partners, and nominates the meeting that a sample of the images supports best.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::index::chi2;
use super::noise::Spread;
use super::sample::Sampler;
use super::scene::Scene;
use crate::ballot::ones;
use crate::hypothesis::Viability;
use crate::kernel::{Gates, LANES};
use crate::progress::{Halt, Progress};
use crate::two_view::{self, View};

/// Images around an image among which partners are sought and votes are sampled, at most.
const SAMPLE_IMAGES: usize = 40;
/// Meetings that a ray is tried with, at most.
const MEETINGS: usize = 12;
/// Cameras nearer to each other than this make no pair, m.
const MIN_BASELINE_M: f64 = 0.5;
/// Poses are taken for as uncertain as at this depth when pairs are looked for, m.
const NEAREST_M: f64 = 4.0;

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

/// Let every free ray nominate a point, if any is supported by a third image.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn nominate(
    scene: &Scene,
    spreads: &[Spread],
    gate_sigmas: f64,
    viability: &Viability,
    free: &[u32],
    progress: &Progress,
) -> Result<Vec<Nomination>, Halt> {
    let centers: Vec<Vector3<f64>> = scene.views.iter().map(|view| view.center).collect();
    let (images, rays_of) = by_image(scene, free);
    let sampler = Sampler::new(&centers, &images, viability.max_range_m);
    let nominated = images
        .par_iter()
        .map(|&image| {
            progress.advance()?;
            let partners = sampler.around(image, MIN_BASELINE_M, SAMPLE_IMAGES);
            let partners: Vec<u32> = partners.iter().flat_map(|&other| &rays_of[other as usize]).copied().collect();
            let booth = Booth::new(scene, spreads, gate_sigmas, viability, image, partners);
            Ok(rays_of[image as usize].iter().filter_map(|&ray| booth.best_meeting(ray)).collect::<Vec<_>>())
        })
        .collect::<Result<Vec<_>, Halt>>()?;
    Ok(nominated.into_iter().flatten().collect())
}

/// Images with free rays, ascending, and the free rays of every image.
fn by_image(scene: &Scene, free: &[u32]) -> (Vec<u32>, Vec<Vec<u32>>) {
    let mut rays_of = vec![Vec::new(); scene.views.len()];
    for &ray in free.iter().filter(|&&ray| scene.ray(ray).is_usable()) {
        rays_of[scene.rays.image[ray as usize] as usize].push(ray);
    }
    let images = (0..rays_of.len() as u32).filter(|&image| !rays_of[image as usize].is_empty()).collect();
    (images, rays_of)
}

/// The rays of a sample of images around one image.
struct Booth<'a> {
    scene: &'a Scene,
    spreads: &'a [Spread],
    gate_sigmas: f64,
    viability: &'a Viability,
    origin: Vector3<f64>,
    partners: Vec<u32>,
    views: Vec<Option<View>>,
    gates: Gates,
}

impl<'a> Booth<'a> {
    fn new(
        scene: &'a Scene,
        spreads: &'a [Spread],
        gate_sigmas: f64,
        viability: &'a Viability,
        image: u32,
        partners: Vec<u32>,
    ) -> Self {
        let origin = scene.views[image as usize].center;
        let local: Vec<_> = partners.iter().map(|&ray| scene.ray(ray).relative_to(&origin)).collect();
        let gates = Gates::new(
            (0..)
                .zip(partners.iter().zip(&local))
                .map(|(lane, (&partner, ray))| (lane, ray, spreads[partner as usize].gate(gate_sigmas))),
        );
        let views = local.iter().map(View::new).collect();
        Self { scene, spreads, gate_sigmas, viability, origin, partners, views, gates }
    }

    fn best_meeting(&self, ray: u32) -> Option<Nomination> {
        let meetings = self.meetings(ray);
        let points: Vec<Vector3<f64>> = meetings.iter().map(|(point, _)| *point).collect();
        let words = self.gates.words();
        let (mut maybe, mut sure) = (vec![0; points.len() * words], vec![0; points.len() * words]);
        self.gates.test(&points, &mut maybe, &mut sure);
        let mut best: Option<(f64, usize)> = None;
        for (i, point) in points.iter().enumerate() {
            let row = i * words..(i + 1) * words;
            let (votes, support) = self.support(ray, point, &maybe[row]);
            if votes >= 2 && best.is_none_or(|(most, _)| support > most) {
                best = Some((support, i));
            }
        }
        best.map(|(support, i)| Nomination {
            point: points[i] + self.origin,
            rays: [ray, self.partners[meetings[i].1]],
            support,
        })
    }

    /// Points (relative to the origin) where a ray meets partners, and the partners' places in the list.
    fn meetings(&self, ray: u32) -> Vec<(Vector3<f64>, usize)> {
        let own = self.scene.ray(ray).relative_to(&self.origin);
        let class = self.scene.rays.class[ray as usize];
        let max_cosine = self.viability.min_parallax_rad.cos();
        let spread = &self.spreads[ray as usize];
        let Some(view) = View::new(&own) else { return Vec::new() };
        let mut meetings = Vec::new();
        for (i, (&partner, partner_view)) in self.partners.iter().zip(&self.views).enumerate() {
            let other = self.scene.ray(partner);
            let Some(other_view) = partner_view else { continue };
            if self.scene.rays.class[partner as usize] != class || !(own.direction.dot(&other.direction) < max_cosine) {
                continue;
            }
            let other_spread = &self.spreads[partner as usize];
            let widest = spread.variance(NEAREST_M).max(other_spread.variance(NEAREST_M)).sqrt() * self.gate_sigmas;
            if two_view::miss(&view, other_view, widest) {
                continue;
            }
            let Some(meeting) = two_view::meet(&view, other_view, widest) else { continue };
            let limit = self.gate_sigmas * self.gate_sigmas;
            let fits = |k: usize, spread: &Spread| {
                meeting.depth[k] > 0.0 && meeting.squared_error[k] < limit * spread.variance(meeting.depth[k])
            };
            let ranges = [own.center, other.center - self.origin].map(|center| (meeting.point - center).norm());
            let in_range = |&r: &f64| r >= self.viability.min_range_m && r <= self.viability.max_range_m;
            if fits(0, spread) && fits(1, other_spread) && ranges.iter().all(in_range) {
                meetings.push((meeting.point, i));
                if meetings.len() == MEETINGS {
                    break;
                }
            }
        }
        meetings
    }

    /// Images of the sample with a ray in whose gate the point lies, and how well: 1 for each image, less the squared
    /// residual of its closest ray as a share of the gate.
    fn support(&self, ray: u32, point: &Vector3<f64>, maybe: &[u64]) -> (u32, f64) {
        let class = self.scene.rays.class[ray as usize];
        let world = point + self.origin;
        let limit = self.gate_sigmas * self.gate_sigmas;
        let (mut votes, mut support) = (0, 0.0);
        let (mut last, mut of_last) = (u32::MAX, 0.0);
        for (word, &maybe) in maybe.iter().enumerate() {
            for bit in ones(maybe) {
                let partner = self.partners[word * LANES + bit as usize];
                let projected = self.scene.ray(partner).project(&world);
                let fit = 1.0 - chi2(&projected, &self.spreads[partner as usize]) / limit;
                if self.scene.rays.class[partner as usize] != class || projected.z <= 0.0 || !(fit > 0.0) {
                    continue;
                }
                let image = self.scene.rays.image[partner as usize];
                if image == last {
                    support += (fit - of_last).max(0.0);
                    of_last = of_last.max(fit);
                } else {
                    votes += 1;
                    support += fit;
                    (last, of_last) = (image, fit);
                }
            }
        }
        (votes, support)
    }
}
