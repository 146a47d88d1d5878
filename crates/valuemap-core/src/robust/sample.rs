//! Partner images: a bounded, reproducible sample of the images around an image, however many passes there are.
//!
//! Every image has a fixed random priority. Level l holds the images with priority below 2^-l, so levels thin out
//! evenly; the sparsest level that still has enough images around serves. The choice depends on distances and image
//! numbers alone, not on the frame.

use nalgebra::Vector3;
use rustc_hash::FxHashMap;

use super::scene::Scene;

const MAX_LEVEL: u32 = 12;

/// Images by level and place.
pub struct Sampler<'a> {
    centers: &'a [Vector3<f64>],
    radius_m: f64,
    levels: Vec<FxHashMap<[i64; 3], Vec<u32>>>,
}

impl<'a> Sampler<'a> {
    /// Prepare to sample among some images; `centers` are those of all images, m.
    #[must_use]
    pub fn new(centers: &'a [Vector3<f64>], images: &[u32], radius_m: f64) -> Self {
        let mut levels: Vec<FxHashMap<[i64; 3], Vec<u32>>> = vec![FxHashMap::default(); MAX_LEVEL as usize + 1];
        for &image in images {
            let cell = cell_of(&centers[image as usize], radius_m);
            let highest = scramble(u64::from(image)).leading_zeros().min(MAX_LEVEL);
            for level in &mut levels[..=highest as usize] {
                level.entry(cell).or_default().push(image);
            }
        }
        Self { centers, radius_m, levels }
    }

    /// At most `most` images within the radius of `image` and farther from it than `min_baseline_m`, in random order.
    #[must_use]
    pub fn around(&self, image: u32, min_baseline_m: f64, most: usize) -> Vec<u32> {
        let center = &self.centers[image as usize];
        let [x, y, z] = cell_of(center, self.radius_m);
        let mut found: Vec<u32> = Vec::new();
        for level in self.levels.iter().rev() {
            found.clear();
            for dx in -1..=1 {
                for dy in -1..=1 {
                    for dz in -1..=1 {
                        let Some(images) = level.get(&[x + dx, y + dy, z + dz]) else { continue };
                        found.extend(images.iter().copied().filter(|&other| {
                            let distance = (self.centers[other as usize] - center).norm();
                            distance <= self.radius_m && distance > min_baseline_m
                        }));
                    }
                }
            }
            if found.len() >= most {
                break;
            }
        }
        found.sort_by_cached_key(|&other| scramble(u64::from(image) << 32 | u64::from(other)));
        found.truncate(most);
        found
    }
}

/// Rays (ascending) of whole places, chosen at random, together about as many as asked for.
///
/// A place is everything within `radius_m` of an image; all rays where the scene is small.
#[must_use]
pub fn places(scene: &Scene, rays: usize, radius_m: f64) -> Vec<u32> {
    let count = scene.rays.rays.len() as u32;
    if count as usize <= rays {
        return (0..count).collect();
    }
    let mut rays_of = vec![0_usize; scene.views.len()];
    for &image in &scene.rays.image {
        rays_of[image as usize] += 1;
    }
    let mut seeds: Vec<u32> = (0..scene.views.len() as u32).collect();
    seeds.sort_by_cached_key(|&image| scramble(u64::from(image)));
    let mut taken = vec![false; scene.views.len()];
    let mut found = 0;
    for seed in seeds {
        if found >= rays {
            break;
        }
        let center = scene.views[seed as usize].center;
        for (image, view) in scene.views.iter().enumerate() {
            if !taken[image] && (view.center - center).norm() <= radius_m {
                taken[image] = true;
                found += rays_of[image];
            }
        }
    }
    (0..count).filter(|&ray| taken[scene.rays.image[ray as usize] as usize]).collect()
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
