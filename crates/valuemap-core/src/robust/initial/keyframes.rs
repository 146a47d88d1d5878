//! Keyframes: one image per camera, pass and stretch of the drive, to find the labels of large scenes faster.
//!
//! Images a few metres apart see the same. One of them tells which labels there are, as well as all of them, in a fraction of the
//! time. All images tell afterwards where the labels are exactly.

use std::sync::Arc;

use rustc_hash::FxHashSet;

use super::label::{Known, Label, Revision};
use crate::ray::Rays;
use crate::robust::scene::Scene;

/// Of the images of one camera and pass, the first of each stretch of this length is kept, m driven. With 6 m 0.3 % of the lights of a simulated city are lost,
/// with 8 m 1 %.
const STRETCH_M: f64 = 4.0;
/// If more than this share of the rays would stay, it is not worth it. All images are gone through afterwards all the same.
const MOST_LEFT: f64 = 0.5;

/// A part of the images of a scene with their rays.
pub struct Keyframes {
    /// These alone.
    pub scene: Scene,
    /// Each ray's number in the whole scene, ascending.
    rays: Vec<u32>,
}

impl Keyframes {
    /// Choose them; nothing if most rays would stay.
    #[must_use]
    pub fn of(scene: &Scene) -> Option<Self> {
        let keyframes = Self::every(scene, STRETCH_M);
        let left = keyframes.rays.len() as f64 / scene.rays.rays.len().max(1) as f64;
        (left <= MOST_LEFT).then_some(keyframes)
    }

    /// The first image of each stretch of `stretch_m` that a camera drove in a pass.
    #[must_use]
    pub fn every(scene: &Scene, stretch_m: f64) -> Self {
        let mut stretches = FxHashSet::default();
        let mut number = vec![None; scene.views.len()];
        let mut images = Vec::new();
        for (image, view) in (0..).zip(&scene.views) {
            if stretches.insert((view.pass, view.camera, (view.driven_m / stretch_m).floor() as i64)) {
                number[image as usize] = Some(images.len() as u32);
                images.push(image);
            }
        }
        let number_of = |ray: u32| number[scene.image_of(ray) as usize];
        let rays: Vec<u32> = (0..scene.rays.rays.len() as u32).filter(|&ray| number_of(ray).is_some()).collect();
        let of_rays = |column: &[f64]| rays.iter().map(|&ray| column[ray as usize]).collect();
        let thinned = Scene {
            rays: Arc::new(Rays {
                rays: rays.iter().map(|&ray| *scene.ray(ray)).collect(),
                image: rays.iter().filter_map(|&ray| number_of(ray)).collect(),
                class: rays.iter().map(|&ray| scene.class_of(ray)).collect(),
            }),
            scale2: of_rays(&scene.scale2),
            box_px: of_rays(&scene.box_px),
            score: of_rays(&scene.score),
            range_m: of_rays(&scene.range_m),
            range_sigma_m: of_rays(&scene.range_sigma_m),
            views: images.iter().map(|&image| scene.views[image as usize]).collect(),
            frusta: scene.frusta.clone(),
        };
        Self { scene: thinned, rays }
    }

    /// A label of the keyframes as one of the whole scene.
    #[must_use]
    pub fn in_whole(&self, label: Label) -> Label {
        let numbers = |of: &[u32], all: &[u32]| of.iter().map(|&number| all[number as usize]).collect();
        Label {
            voters: numbers(&label.voters, &self.rays),
            refused: numbers(&label.refused, &self.rays),
            revision: Revision::default(),
            known: Known::default(),
            ..label
        }
    }
}
