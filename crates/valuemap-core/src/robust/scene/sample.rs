//! Partner images: a bounded, reproducible sample of the images around an image, however many passes there are.
//!
//! Every image has a fixed random priority. Level l holds the images with priority below 2^-l, so levels thin out evenly. The
//! sparsest level that still has enough images around serves. The choice depends on distances and image numbers alone, not on the
//! frame.

use std::cmp::Reverse;

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::Scene;

/// The highest level: one image in 4,096 is on it, so that of 160,000 images around an image some forty are.
const MAX_LEVEL: u32 = 12;
/// Images around which it is counted how many there are. The rank of their median is known to 3 %, and an odd number has a middle one.
const DENSITY_IMAGES: usize = 255;

/// Images by place, the highest level first.
pub struct Sampler<'a> {
    centers: &'a [Vector3<f64>],
    radius_m: f64,
    places: FxHashMap<[i64; 3], Vec<u32>>,
}

impl<'a> Sampler<'a> {
    /// Prepare to sample among some images; `centers` are those of all images, m.
    #[must_use]
    pub fn new(centers: &'a [Vector3<f64>], images: &[u32], radius_m: f64) -> Self {
        let mut places = by_cell(centers, images.iter().copied(), radius_m);
        for images in places.values_mut() {
            images.sort_unstable_by_key(|&image| (Reverse(level_of(image)), image));
        }
        Self { centers, radius_m, places }
    }

    /// At most `most` images within the radius of `image` and elsewhere, in random order.
    #[must_use]
    pub fn around(&self, image: u32, most: usize) -> Vec<u32> {
        let (mut found, _) = self.thinned(image, most);
        found.sort_by_cached_key(|&other| scramble(u64::from(image) << 32 | u64::from(other)));
        found.truncate(most);
        found
    }

    /// The highest level that still has `enough` images around an image: the median of a sample of the images.
    #[must_use]
    pub fn level_with(&self, enough: usize) -> u32 {
        let mut images: Vec<u32> = self.places.values().flatten().copied().collect();
        images.sort_unstable_by_key(|&image| (Reverse(level_of(image)), image));
        images.truncate(DENSITY_IMAGES);
        let mut levels: Vec<u32> = images.iter().map(|&image| self.thinned(image, enough).1).collect();
        levels.sort_unstable();
        levels.get(levels.len() / 2).copied().unwrap_or(0)
    }

    /// The images around an image on the highest level that has enough of them, else on the lowest; and that level.
    fn thinned(&self, image: u32, enough: usize) -> (Vec<u32>, u32) {
        let center = &self.centers[image as usize];
        let near = cells_around(center, self.radius_m);
        let mut places: Vec<&[u32]> = near.filter_map(|cell| self.places.get(&cell).map(Vec::as_slice)).collect();
        let mut found: Vec<u32> = Vec::new();
        for level in (0..=MAX_LEVEL).rev() {
            for place in &mut places {
                let of_level = place.iter().take_while(|&&other| level_of(other) >= level).count();
                let (of_level, below) = place.split_at(of_level);
                found.extend(of_level.iter().copied().filter(|&other| {
                    let distance = (self.centers[other as usize] - center).norm();
                    distance <= self.radius_m && distance > 0.0
                }));
                *place = below;
            }
            if found.len() >= enough {
                return (found, level);
            }
        }
        (found, 0)
    }
}

/// The highest level that an image is on.
#[must_use]
pub fn level_of(image: u32) -> u32 {
    scramble(u64::from(image)).leading_zeros().min(MAX_LEVEL)
}

/// A number that tells some rays, in one order, from others.
#[must_use]
pub fn fingerprint(rays: &[u32]) -> u64 {
    rays.iter().fold(0, |sum, &ray| scramble(sum ^ u64::from(ray)))
}

/// Rays (ascending) of whole places, chosen at random, together about as many as asked for.
///
/// A place is everything within `radius_m` of an image; all rays where the scene is small.
#[must_use]
pub fn places(scene: &Scene, rays: usize, radius_m: f64) -> Vec<u32> {
    let usable = scene.usable_rays();
    if usable.len() <= rays {
        return usable;
    }
    let image_of = |ray: u32| scene.image_of(ray) as usize;
    let mut rays_of = vec![0_usize; scene.views.len()];
    for &ray in &usable {
        rays_of[image_of(ray)] += 1;
    }
    let centers: Vec<Vector3<f64>> = scene.views.iter().map(|view| view.center).collect();
    let images = 0..scene.views.len() as u32;
    let by_cell = by_cell(&centers, images.clone(), radius_m);
    let mut seeds: Vec<u32> = images.collect();
    seeds.par_sort_by_cached_key(|&image| scramble(u64::from(image)));
    let mut taken = vec![false; scene.views.len()];
    let mut found = 0;
    for seed in seeds {
        if found >= rays {
            break;
        }
        let center = &centers[seed as usize];
        for &image in cells_around(center, radius_m).filter_map(|cell| by_cell.get(&cell)).flatten() {
            let image = image as usize;
            if !taken[image] && (centers[image] - center).norm() <= radius_m {
                taken[image] = true;
                found += rays_of[image];
            }
        }
    }
    usable.into_iter().filter(|&ray| taken[image_of(ray)]).collect()
}

/// Those of some rays (ascending) that are of whole passes, chosen at random, together about as many as asked for.
#[must_use]
pub fn passes(scene: &Scene, rays: Vec<u32>, most: usize) -> Vec<u32> {
    if rays.len() <= most {
        return rays;
    }
    let mut count: FxHashMap<u32, usize> = FxHashMap::default();
    for &ray in &rays {
        *count.entry(scene.view(ray).pass).or_default() += 1;
    }
    let mut order: Vec<(u64, u32)> = count.keys().map(|&pass| (scramble(u64::from(pass)), pass)).collect();
    order.sort_unstable();
    let mut found = 0;
    let mut taken: FxHashSet<u32> = FxHashSet::default();
    for (_, pass) in order {
        if found >= most {
            break;
        }
        found += count[&pass];
        taken.insert(pass);
    }
    rays.into_iter().filter(|&ray| taken.contains(&scene.view(ray).pass)).collect()
}

/// Images by the cube that they were taken in.
fn by_cell(centers: &[Vector3<f64>], images: impl Iterator<Item = u32>, side_m: f64) -> FxHashMap<[i64; 3], Vec<u32>> {
    let mut cells: FxHashMap<[i64; 3], Vec<u32>> = FxHashMap::default();
    for image in images {
        cells.entry(cell_of(&centers[image as usize], side_m)).or_default().push(image);
    }
    cells
}

/// The cubes with everything that is within one side of a point.
fn cells_around(center: &Vector3<f64>, side_m: f64) -> impl Iterator<Item = [i64; 3]> {
    let [x, y, z] = cell_of(center, side_m);
    (0..27).map(move |step| {
        [x.saturating_add(step / 9 - 1), y.saturating_add(step / 3 % 3 - 1), z.saturating_add(step % 3 - 1)]
    })
}

fn cell_of(center: &Vector3<f64>, side_m: f64) -> [i64; 3] {
    [0, 1, 2].map(|axis| (center[axis] / side_m).floor() as i64)
}

/// Spread numbers evenly over 64 bits (the finaliser of Steele, Lea and Flood, "Fast splittable pseudorandom number
/// generators", OOPSLA 2014).
#[must_use]
pub fn scramble(number: u64) -> u64 {
    let mut z = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::street;

    #[test]
    fn of_many_drives_some_are_taken_whole() {
        let at = Vector3::new(30.0, 4.0, 3.0);
        let drive = || street::street(5, 2.0, &[at], &[[0.0, 0.0]]);
        let scene = street::joined((0..20).map(|_| drive()).collect());
        let all = scene.usable_rays();
        assert_eq!(passes(&scene, all.clone(), all.len()), all);
        let some = passes(&scene, all.clone(), 22);
        // Five drives of five rays are the first that are enough.
        assert_eq!(some.len(), 25);
        assert!(some.is_sorted());
        let of = |pass: u32| some.iter().filter(|&&ray| scene.view(ray).pass == pass).count();
        assert!((0..20).all(|pass| of(pass) == 0 || of(pass) == 5));
    }
}
