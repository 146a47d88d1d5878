//! The looks at an object: the viewpoints that should see it.
//!
//! A look is a viewpoint of a pass that has the point in its picture, from a side from which the object was voted for, at a distance from which its class
//! is detected; it counts less where fewer are detected. It is as much of a hit as the share of its images that have a vote. Which of the looks are hits has
//! a price, the last two terms of equation (5) of `docs/method.md`. Of the images of a viewpoint it is one of equally probable choices: a standing car would
//! see two objects in turn otherwise. And a hit is as rare as a look there is light: looks from afar would be for what meets by chance, and never against it.

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;
use rustc_hash::FxHashMap;

use super::Object;
use super::seen::{Looks, Seen};
use crate::robust::model::aspect::Directions;
use crate::robust::model::{ClassModel, Model, ln_gamma};
use crate::robust::parts::Part;
use crate::robust::scene::{Scene, View};

/// Images are grouped by cubes of this share of the range: some hundred cubes are in reach of a point.
const CUBE_SHARE: f64 = 1.0 / 6.0;
/// Half of the angle of a sector (cosine of 15 degrees): housings and faces are detected about so much farther to the side than
/// the farthest vote, and no more is known.
pub(crate) const SECTOR_COSINE: f64 = 0.966;

/// All images by place.
pub struct Lookout {
    cubes: RTree<GeomWithData<[f64; 3], Vec<u32>>>,
    reach_m: f64,
}

impl Lookout {
    /// Index all images of a scene of which objects are seen up to about `range_m`.
    #[must_use]
    pub fn new(scene: &Scene, range_m: f64) -> Self {
        let side = range_m * CUBE_SHARE;
        let mut images: FxHashMap<[i64; 3], Vec<u32>> = FxHashMap::default();
        for (image, view) in (0..).zip(&scene.views) {
            let cube = [0, 1, 2].map(|axis| (view.center[axis] / side).floor() as i64);
            images.entry(cube).or_default().push(image);
        }
        let middle = |cube: [i64; 3]| cube.map(|index| (index as f64 + 0.5) * side);
        let cubes = images.into_iter().map(|(cube, images)| GeomWithData::new(middle(cube), images));
        Self { cubes: RTree::bulk_load(cubes.collect()), reach_m: 0.5 * side * 3.0_f64.sqrt() }
    }

    /// All images within a distance of a point, and some farther ones, in no order.
    pub(crate) fn around(&self, point: &Vector3<f64>, distance_m: f64) -> impl Iterator<Item = u32> {
        let reach = distance_m + self.reach_m;
        self.cubes.locate_within_distance((*point).into(), reach * reach).flat_map(|near| near.data.iter().copied())
    }

    /// The images that look at a point from one of some sectors and have it in their picture, each with the sector, in no order.
    fn looking<'a>(
        &'a self,
        scene: &'a Scene,
        point: &'a Vector3<f64>,
        sectors: &'a Sectors,
    ) -> impl Iterator<Item = (u32, usize)> + 'a {
        let farthest_m = sectors.0.iter().map(|sector| sector.farthest_m).fold(0.0, f64::max);
        self.around(point, farthest_m)
            .filter_map(move |image| Some((image, sectors.looked_from(scene, &scene.views[image as usize], point)?)))
    }

    /// The looks at a point that some rays (one per image, ascending) vote for, from as near and as far as their class is detected.
    #[must_use]
    pub fn looks(&self, model: &Model<'_>, point: &Vector3<f64>, voters: &[u32]) -> Seen {
        let Some(class) = model.class_of_votes(voters) else { return Seen::default() };
        // Before anything is learned, objects are seen from between their nearest and their farthest vote.
        let distances_m =
            if class.is_learned || model.pooled.is_learned { (0.0, class.farthest_m) } else { (f64::INFINITY, 0.0) };
        let scene = model.scene;
        let has = |part: Part| model.settings.has(part);
        let sectors = Sectors::of(scene, point, voters, distances_m);
        let mut looks: Vec<Look> = Vec::with_capacity(2 * voters.len());
        for &ray in voters {
            let away = scene.ray(ray).center - point;
            let sector = sectors.nearest(&away);
            if away.norm() > sectors.0[sector].farthest_m {
                continue;
            }
            let rate = if has(Part::FarHits) { class.reach.at(away.norm()) } else { 1.0 };
            looks.push(Look { sector, image: scene.image_of(ray), weight: 1.0, hit: Some(rate) });
        }
        let hits = images_of(scene, voters);
        let seen_from = Directions::of(scene, point, voters);
        for (image, sector) in self.looking(scene, point, &sectors) {
            if hits.binary_search(&image).is_err() {
                let view = &scene.views[image as usize];
                let weight = rate(class, &seen_from, view, point);
                looks.push(Look { sector, image, weight, hit: None });
            }
        }
        // Images are numbered along the drives: sorted, those of a viewpoint are side by side.
        looks.sort_unstable_by_key(|look| (look.sector, look.image));
        let view = |look: &Look| &scene.views[look.image as usize];
        let mut ln_which = 0.0;
        let mut of_pass = |pass: &[Look]| {
            let mut sum = Looks { expected: 0.0, hits: 0.0 };
            for images in pass.chunk_by(|a, b| view(a).viewpoint == view(b).viewpoint) {
                let (one, ln_which_images) = of_viewpoint(images, has(Part::Turns));
                sum.hits += one.hits;
                sum.expected += one.expected;
                ln_which += ln_which_images;
            }
            sum
        };
        let mut of_sector =
            |sector: &[Look]| sector.chunk_by(|a, b| view(a).pass == view(b).pass).map(&mut of_pass).collect();
        let sectors = looks.chunk_by(|a, b| a.sector == b.sector).map(&mut of_sector).collect();
        Seen { sectors, ln_which }
    }

    /// Tells of objects whether all images in reach of them have only detections among some rays: their votes are counted in full.
    pub fn whole<'a>(&'a self, model: &'a Model<'_>, rays: &[u32]) -> impl Fn(&Object) -> bool {
        let mut is_left_out = vec![false; model.scene.views.len()];
        let image = |ray: u32| model.scene.image_of(ray) as usize;
        for ray in model.scene.usable_rays() {
            is_left_out[image(ray)] = true;
        }
        for &ray in rays {
            is_left_out[image(ray)] = false;
        }
        move |object| {
            let reach_m = model.classes[object.class as usize].farthest_m;
            let point = &object.fit.point;
            let is_near = |&image: &u32| (model.scene.views[image as usize].center - point).norm() <= reach_m;
            !self.around(point, reach_m).filter(is_near).any(|image| is_left_out[image as usize])
        }
    }

    /// How many images should have seen a point that some rays (one per image, ascending) vote for, these included: those that have it in their picture
    /// from a direction from which it was voted for, no nearer and no farther than the votes from there.
    #[must_use]
    pub fn expected(&self, scene: &Scene, point: &Vector3<f64>, voters: &[u32]) -> u32 {
        let sectors = Sectors::of(scene, point, voters, (f64::INFINITY, 0.0));
        let hits = images_of(scene, voters);
        let missed = self.looking(scene, point, &sectors).filter(|(image, _)| hits.binary_search(image).is_err());
        (hits.len() + missed.count()) as u32
    }

    /// The images that look at a point from where some rays vote for it, up to `farthest_m`, and whether they have a vote.
    #[must_use]
    pub fn seen(&self, model: &Model<'_>, point: &Vector3<f64>, voters: &[u32], farthest_m: f64) -> Vec<(u32, bool)> {
        let scene = model.scene;
        let sectors = Sectors::of(scene, point, voters, (0.0, farthest_m));
        let hits = images_of(scene, voters);
        let is_near = |image: &u32| (scene.views[*image as usize].center - point).norm() <= farthest_m;
        let images = self.looking(scene, point, &sectors).map(|(image, _)| image).filter(is_near);
        images.map(|image| (image, hits.binary_search(&image).is_ok())).collect()
    }
}

/// Logarithm of in how many ways some of all images are chosen: the binomial coefficient.
pub(crate) fn ln_choices(all: f64, some: f64) -> f64 {
    ln_gamma(all + 1.0) - ln_gamma(some + 1.0) - ln_gamma(all - some + 1.0)
}

/// An image that should have seen an object.
struct Look {
    sector: usize,
    image: u32,
    weight: f64,
    /// If it has a vote, how much rarer than at best these are from so far.
    hit: Option<f64>,
}

/// The images of a viewpoint are one look: it, and the logarithm of how probable it is that those of them are hits that are.
fn of_viewpoint(images: &[Look], has_turns: bool) -> (Looks, f64) {
    let rates = images.iter().filter_map(|image| image.hit);
    let hits = rates.clone().count() as f64;
    let expected = images.iter().map(|image| image.weight).fold(0.0, f64::max);
    if hits == 0.0 {
        return (Looks { expected, hits }, 0.0);
    }
    let all: f64 = images.iter().map(|image| image.weight).sum();
    let turns = if has_turns && hits < all { ln_choices(all, hits) } else { 0.0 };
    let hit = expected * hits / all;
    (Looks { expected, hits: hit }, hit * rates.map(f64::ln).sum::<f64>() / hits - turns)
}

/// How many looks at an object the images of some rays are: those that have it in their picture, from where and as far as its class is detected.
#[must_use]
pub fn looks_among(model: &Model<'_>, object: &Object, rays: &[u32]) -> f64 {
    let (scene, point) = (model.scene, &object.fit.point);
    let class = &model.classes[object.class as usize];
    let sectors = Sectors::of(scene, point, &object.votes, (0.0, class.farthest_m));
    let views = rays.iter().map(|&ray| scene.view(ray));
    let views = views.filter(|view| sectors.looked_from(scene, view, point).is_some());
    let seen_from = Directions::of(scene, point, &object.votes);
    views.map(|view| rate(class, &seen_from, view, point)).sum()
}

/// How much rarer than at best a class is detected in an image that looks at a point.
fn rate(class: &ClassModel, seen_from: &Directions, view: &View, point: &Vector3<f64>) -> f64 {
    let away = view.center - point;
    let distance_m = away.norm();
    class.reach.at(distance_m) * seen_from.rate(&class.aspect, view.pass, &(away / distance_m))
}

/// The images of some rays, ascending.
fn images_of(scene: &Scene, rays: &[u32]) -> Vec<u32> {
    let mut images: Vec<u32> = rays.iter().map(|&ray| scene.image_of(ray)).collect();
    images.sort_unstable();
    images
}

/// From where an object is seen.
struct Sectors(Vec<Sector>);

struct Sector {
    /// The middle, from the object.
    direction: Vector3<f64>,
    /// What is nearer is seen by few: that of the nearest vote, or of the class.
    nearest_m: f64,
    /// What is farther is seen by few: that of the second farthest vote, or of the class.
    farthest_m: f64,
    farthest_vote_m: f64,
}

impl Sectors {
    /// Those of some votes, from at least so near and as far as those two distances say. One vote from farther away may be clutter, and is no
    /// look: all images that are nearer would count against the object, from where it is hardly ever detected. Where nothing is known (0 m), sides reach
    /// as far as their farthest vote.
    fn of(scene: &Scene, point: &Vector3<f64>, voters: &[u32], (nearest_m, farthest_m): (f64, f64)) -> Self {
        let is_known = farthest_m > 0.0;
        let mut sectors: Vec<Sector> = Vec::new();
        for &ray in voters {
            let away = scene.ray(ray).center - point;
            let distance = away.norm();
            let direction = away / distance;
            if let Some(sector) = sectors.iter_mut().find(|sector| sector.direction.dot(&direction) >= SECTOR_COSINE) {
                sector.nearest_m = sector.nearest_m.min(distance);
                let (nearer_m, farther_m) =
                    (sector.farthest_vote_m.min(distance), sector.farthest_vote_m.max(distance));
                sector.farthest_m = sector.farthest_m.max(if is_known { nearer_m } else { farther_m });
                sector.farthest_vote_m = farther_m;
            } else {
                sectors.push(Sector {
                    direction,
                    nearest_m: nearest_m.min(distance),
                    farthest_m: if is_known { farthest_m } else { distance },
                    farthest_vote_m: distance,
                });
            }
        }
        Self(sectors)
    }

    /// The sector that holds a camera that is so far away.
    fn holding(&self, away: &Vector3<f64>) -> Option<usize> {
        let distance = away.norm();
        let holds = |sector: &Sector| {
            distance >= sector.nearest_m
                && distance <= sector.farthest_m
                && sector.direction.dot(away) >= SECTOR_COSINE * distance
        };
        self.0.iter().position(holds)
    }

    /// The sector from which an image looks at a point that it has in its picture.
    fn looked_from(&self, scene: &Scene, view: &View, point: &Vector3<f64>) -> Option<usize> {
        let sector = self.holding(&(view.center - point))?;
        scene.is_in_picture(view, point).then_some(sector)
    }

    /// The sector of a vote from so far away.
    fn nearest(&self, away: &Vector3<f64>) -> usize {
        self.holding(away).unwrap_or_else(|| {
            let cosines = self.0.iter().map(|sector| sector.direction.dot(away));
            cosines.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(sector, _)| sector)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::object;
    use super::*;
    use crate::robust::model::steps::{BINS, Steps};
    use crate::robust::parts::Without;
    use crate::robust::scene::Scene;
    use crate::robust::settings::Settings;
    use crate::street;

    /// J of what a standing car and one that drives see of one object, and of two that are seen in turn: by the one that stands each with what is to
    /// one side of the middle, by the other each in every other image.
    fn energies(settings: &Settings) -> (f64, f64) {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [2.0_f64.sqrt() * (f64::from(i) * 1.7).sin(), 0.0]).collect();
        let at = Vector3::new(30.0, 4.0, 3.0);
        let standing = street::street(160, 0.0, &[at], &errors);
        let views = standing.views.iter().map(|view| View { viewpoint: 0, ..*view }).collect();
        let driving = street::street(10, 2.0, &[at], &errors);
        let scene = street::joined(vec![Scene { views, ..standing }, driving]);
        let model = Model::new(&scene, &street::NOISE, settings);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let energy = |votes: Vec<u32>| object(&model, &lookout, votes, at).map_or(f64::NAN, |o| o.energy);
        let is_first =
            |ray: &u32| if *ray < 160 { errors[*ray as usize % errors.len()][0] > 0.0 } else { ray.is_multiple_of(2) };
        let (first, second) = scene.usable_rays().iter().partition(|ray| is_first(ray));
        (energy(scene.usable_rays()), energy(first) + energy(second))
    }

    #[test]
    fn what_a_standing_car_sees_is_not_two_objects_in_turn() {
        let (one, two) = energies(&street::SETTINGS);
        assert!(one < two, "{one} {two}");
        let without = Without::named(&["turns".to_owned()]).unwrap_or_default();
        let (one, two) = energies(&Settings { without, ..street::SETTINGS });
        assert!(two < one, "{one} {two}");
    }

    #[test]
    fn hits_are_as_rare_as_looks_from_there_are_light() {
        let at = Vector3::new(60.0, 4.0, 3.0);
        let mut scene = street::street(51, 1.0, &[at], &[[0.0, 0.0]]);
        // Two images are one viewpoint.
        scene.views[16].viewpoint = scene.views[15].viewpoint;
        let ln_which = |votes: &[u32], rate: f64, settings: &Settings| {
            let mut model = Model::new(&scene, &street::NOISE, settings);
            (model.classes[0].is_learned, model.classes[0].farthest_m) = (true, 60.0);
            let rates = std::array::from_fn(|bin| if bin < BINS / 2 { 1.0 } else { rate });
            model.classes[0].reach = Steps::even(60.0, rates);
            Lookout::new(&scene, street::VIABILITY.max_range_m).looks(&model, &at, votes).ln_which
        };
        let price = |votes: &[u32], settings: &Settings| {
            ln_which(votes, 1.0, &street::SETTINGS) - ln_which(votes, 0.1, settings)
        };
        // From less than 20 m, and from 40 to 47 m: eight votes of seven viewpoints.
        let (near, far): (Vec<u32>, Vec<u32>) = ((32..40).collect(), (2..10).collect());
        assert!(price(&near, &street::SETTINGS).abs() < 1e-9);
        assert!((price(&far, &street::SETTINGS) - 7.0 * 10.0_f64.ln()).abs() < 1e-9);
        let without = Without::named(&["far_hits".to_owned()]).unwrap_or_default();
        assert!(price(&far, &Settings { without, ..street::SETTINGS }).abs() < 1e-9);
    }

    #[test]
    fn one_vote_from_farther_than_a_class_is_detected_is_no_look_and_two_are() {
        let at = Vector3::new(60.0, 4.0, 3.0);
        let scene = street::street(51, 1.0, &[at], &[[0.0, 0.0]]);
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        (model.classes[0].is_learned, model.classes[0].farthest_m) = (true, 30.0);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let looks = |votes: &[u32]| {
            let passes = lookout.looks(&model, &at, votes).sectors.concat();
            let sum = |of: fn(&Looks) -> f64| passes.iter().map(of).sum::<f64>();
            (sum(|looks| looks.hits), sum(|looks| looks.expected))
        };
        // All rays but the first twenty are from no farther than 29.4 m.
        let near: Vec<u32> = (20..40).collect();
        let with = |far: &[u32]| looks(&[far, &near].concat());
        assert_eq!(with(&[]), (20.0, 20.0));
        assert_eq!(with(&[2]), with(&[]));
        assert_eq!(with(&[2, 12]), (21.0, 28.0));
    }

    #[test]
    fn choices_are_counted() {
        assert!((ln_choices(5.0, 2.0).exp() - 10.0).abs() < 1e-6 && ln_choices(4.0, 4.0).abs() < 1e-9);
    }
}
