//! Spatial index of the rays: which rays see a point.
//!
//! Rays are grouped by the place that they were taken from, and laid out for the vectorised kernel ([`kernel`](crate::kernel)).

use nalgebra::Vector3;
use rayon::prelude::*;
use rstar::RTree;
use rstar::primitives::GeomWithData;
use rustc_hash::FxHashMap;

use super::Spread;
use crate::kernel::{Gates, LANES, ones};
use crate::ray::Ray;
use crate::robust::scene::Scene;

/// Side of the cubes that rays are grouped by, m: one or two blocks of the kernel a pass.
const PLACE_M: f64 = 20.0;

/// A ray that a point projects onto.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// The ray.
    pub ray: u32,
    /// Its image.
    pub image: u32,
    /// Squared residual over its variance.
    pub chi2: f64,
}

/// Rays by place.
pub struct RayIndex<'a> {
    scene: &'a Scene,
    spreads: &'a [Spread],
    gate_sigmas: f64,
    places: Vec<Place>,
    tree: RTree<GeomWithData<[f64; 3], usize>>,
    /// How far a ray's camera may be from the origin of its place, m.
    reach_m: f64,
}

struct Place {
    origin: Vector3<f64>,
    rays: Vec<u32>,
    /// Their classes.
    classes: Vec<u32>,
    gates: Gates,
}

impl<'a> RayIndex<'a> {
    /// Index the given rays (ascending); `spreads` are those of all rays of the scene.
    #[must_use]
    pub fn new(scene: &'a Scene, spreads: &'a [Spread], gate_sigmas: f64, rays: impl Iterator<Item = u32>) -> Self {
        let mut members: FxHashMap<[i64; 3], Vec<u32>> = FxHashMap::default();
        for ray in rays.filter(|&ray| scene.ray(ray).is_usable()) {
            let center = scene.ray(ray).center;
            let cell = [0, 1, 2].map(|axis| (center[axis] / PLACE_M).floor() as i64);
            members.entry(cell).or_default().push(ray);
        }
        let mut places: Vec<Place> =
            members.into_par_iter().map(|(_, rays)| Place::new(scene, spreads, gate_sigmas, rays)).collect();
        places.sort_by_key(|place| place.rays[0]);
        let tree = RTree::bulk_load(
            places.iter().enumerate().map(|(i, place)| GeomWithData::new(place.origin.into(), i)).collect(),
        );
        Self { scene, spreads, gate_sigmas, places, tree, reach_m: PLACE_M * 3.0_f64.sqrt() }
    }

    /// The gate, in sigmas.
    #[must_use]
    pub fn gate_sigmas(&self) -> f64 {
        self.gate_sigmas
    }

    /// The spreads of all rays of the scene.
    #[must_use]
    pub fn spreads(&self) -> &'a [Spread] {
        self.spreads
    }

    /// The rays of one class within `range_m` that a point projects onto within their gates and that `keep` admits,
    /// the closest of each image; ordered by image.
    #[must_use]
    pub fn hits(&self, point: &Vector3<f64>, class: u32, range_m: f64, keep: &dyn Fn(u32) -> bool) -> Vec<Hit> {
        let mut hits = self.all_hits(point, class, range_m);
        hits.retain(|hit| keep(hit.ray));
        hits.sort_by(|a, b| (a.image.cmp(&b.image)).then(a.chi2.total_cmp(&b.chi2)).then(a.ray.cmp(&b.ray)));
        hits.dedup_by_key(|hit| hit.image);
        hits
    }

    /// All rays of one class within `range_m` that a point projects onto within their gates, in no order.
    #[must_use]
    pub fn all_hits(&self, point: &Vector3<f64>, class: u32, range_m: f64) -> Vec<Hit> {
        self.hits_of_any(std::slice::from_ref(point), &|said| said == class, range_m)
    }

    /// The rays of some classes that [`all_hits`](Self::all_hits) finds for any of some points, each with its least residual; in no order.
    #[must_use]
    pub fn hits_of_any(&self, points: &[Vector3<f64>], is_of: &dyn Fn(u32) -> bool, range_m: f64) -> Vec<Hit> {
        let Some(&middle) = points.get(points.len() / 2) else { return Vec::new() };
        let span = points.iter().map(|point| (point - middle).norm()).fold(0.0, f64::max);
        let reach = range_m + span + self.reach_m;
        let mut hits = Vec::new();
        let mut near_points = Vec::with_capacity(points.len());
        let mut around = Vec::with_capacity(points.len());
        let mut maybe = Vec::new();
        for near in self.tree.locate_within_distance(middle.into(), reach * reach) {
            let place = &self.places[near.data];
            near_points.clear();
            near_points.extend(
                points.iter().filter(|point| (*point - place.origin).norm() <= range_m + self.reach_m).copied(),
            );
            around.clear();
            around.extend(near_points.iter().map(|point| point - place.origin));
            let words = place.gates.words();
            maybe.resize(words * around.len(), 0);
            place.gates.test_maybe(&around, &mut maybe);
            for word in 0..words {
                let bits_of = |point: usize| maybe[point * words + word];
                let any = (0..around.len()).fold(0, |any, point| any | bits_of(point));
                let lane_of = |bit: u32| word * LANES + bit as usize;
                let nearest = |bit: u32| {
                    let near = near_points.iter().enumerate().filter(|(point, _)| bits_of(*point) >> bit & 1 == 1);
                    let of_ray = near.filter_map(|(_, point)| self.hit(place.rays[lane_of(bit)], point, range_m));
                    of_ray.min_by(|a, b| a.chi2.total_cmp(&b.chi2))
                };
                // Points far away may be in the gate of lanes without a ray, as far as single precision tells.
                let of_class = |&bit: &u32| place.classes.get(lane_of(bit)).is_some_and(|&class| is_of(class));
                hits.extend(ones(any).filter(of_class).filter_map(nearest));
            }
        }
        hits
    }

    fn hit(&self, ray: u32, point: &Vector3<f64>, range_m: f64) -> Option<Hit> {
        let chi2 = chi2_in_gate(self.scene.ray(ray), point, &self.spreads[ray as usize], self.gate_sigmas)?;
        let near = (point - self.scene.ray(ray).center).norm_squared() <= range_m * range_m;
        near.then(|| Hit { ray, image: self.scene.image_of(ray), chi2 })
    }
}

impl Place {
    fn new(scene: &Scene, spreads: &[Spread], gate_sigmas: f64, rays: Vec<u32>) -> Self {
        let origin = scene.ray(rays[0]).center;
        let local: Vec<_> = rays.iter().map(|&ray| scene.ray(ray).relative_to(&origin)).collect();
        let gates = Gates::new(
            (0..)
                .zip(rays.iter().zip(&local))
                .map(|(lane, (&r, ray))| (lane, ray, spreads[r as usize].gate(gate_sigmas))),
        );
        let classes = rays.iter().map(|&ray| scene.class_of(ray)).collect();
        Self { origin, rays, classes, gates }
    }
}

/// Squared residual of a point over its variance, if it lies in the gate of a ray.
#[must_use]
pub fn chi2_in_gate(ray: &Ray, point: &Vector3<f64>, spread: &Spread, gate_sigmas: f64) -> Option<f64> {
    let projected = ray.project(point);
    let chi2 = chi2(&projected, spread);
    (projected.z > 0.0 && chi2 < gate_sigmas * gate_sigmas).then_some(chi2)
}

/// Squared residual over the variance at the point's depth, of `(a, b, c)` in front of the camera.
#[inline]
#[must_use]
pub fn chi2(projected: &Vector3<f64>, spread: &Spread) -> f64 {
    let depth2 = projected.z * projected.z;
    (projected.x * projected.x + projected.y * projected.y) / (spread.far_px2 * depth2 + spread.near_px2)
}
