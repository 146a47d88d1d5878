//! Copies: two objects for one thing, which a camera sees in turn and never together.
//!
//! Where poses are off by more than was thought, images whose errors are alike make an object of their own, and others the next one a metre aside. Each of the
//! two is detected where it should be, but for images that have the other one instead. Of two things that stand beside each other a camera shows both now
//! and then: while both are in its view, whether it detects the one has nothing to do with whether it detects the other.

use rayon::prelude::*;
use rustc_hash::FxHashSet;

use super::one::share_of_one;
use crate::robust::energy::looks::{Lookout, SECTOR_COSINE, ln_choices};
use crate::robust::energy::places::by_place;
use crate::robust::energy::{Object, size_of};
use crate::robust::model::Model;
use crate::robust::parts::Part;
use crate::robust::scene::Scene;
use crate::robust::search::rearrange::may_be_one;

/// Things whose middles are apart by less than this share of their size, across the line of sight, hide each other: of a half that is left of it little is
/// detected, and of two boxes that overlap by more than a half, those less than a third apart, detectors keep one (non-maximum suppression).
const HIDING: f64 = 0.5;

/// The probability that each of some objects is no copy of one that J would miss more and that is none itself.
#[must_use]
pub fn not_copies(model: &Model<'_>, lookout: &Lookout, objects: &[Object]) -> Vec<f64> {
    let mut none = vec![1.0; objects.len()];
    if !model.settings.has(Part::Copies) {
        return none;
    }
    let told = told(model, lookout, objects);
    let of_each = told.chunk_by(|a, b| a.weaker == b.weaker);
    let most = of_each.map(|pairs| pairs.iter().map(|pair| pair.odds).fold(0.0, f64::max));
    let (two, one): (Vec<f64>, Vec<f64>) = most.partition(|&odds| odds <= 0.0);
    let share = share_of_one(&one, two.len());
    for pair in &told {
        if none[pair.stronger] > 0.5 {
            // What was not told anything is what it was.
            none[pair.weaker] = f64::min(none[pair.weaker], 1.0 / (1.0 - share + share * pair.odds));
        }
    }
    none
}

/// Two objects that may be one, and how much likelier their images are if they are; 0 where one shows both.
struct Pair {
    weaker: usize,
    stronger: usize,
    odds: f64,
}

/// All pairs of which images tell anything, by the weaker one from the one that J would miss most.
fn told(model: &Model<'_>, lookout: &Lookout, objects: &[Object]) -> Vec<Pair> {
    let mut order: Vec<usize> = (0..objects.len()).collect();
    order.sort_unstable_by(|&a, &b| objects[a].energy.total_cmp(&objects[b].energy).then(a.cmp(&b)));
    let mut rank = vec![0; objects.len()];
    order.iter().enumerate().for_each(|(at, &row)| rank[row] = at);
    let images: Vec<Vec<Image>> = objects.iter().map(|object| images_of(model.scene, object)).collect();
    let tree = by_place(objects.iter().map(|object| object.fit.point));
    let of_one = |&weaker: &usize| -> Vec<Pair> {
        let object = &objects[weaker];
        let reach_m = same_side_m(model, object);
        let near = tree.locate_within_distance(object.fit.point.into(), reach_m * reach_m).map(|near| near.data);
        let may_be = |&other: &usize| rank[other] < rank[weaker] && may_be_one(model, &objects[other], object);
        let mut stronger: Vec<usize> = near.filter(may_be).collect();
        stronger.sort_unstable_by_key(|&other| rank[other]);
        let pair = |stronger: usize| {
            let of = [&images[weaker][..], &images[stronger][..]];
            let is_two = of[0].iter().any(|image| of[1].binary_search(image).is_ok());
            let odds = || (-ln_never_together(model, lookout, [object, &objects[stronger]], of)).exp();
            Pair { weaker, stronger, odds: if is_two { 0.0 } else { odds() } }
        };
        stronger.into_iter().map(pair).filter(|pair| pair.odds > 1.0 || pair.odds <= 0.0).collect()
    };
    order.par_iter().flat_map_iter(of_one).collect()
}

/// How far from an object others are on the same side of all its images, m.
fn same_side_m(model: &Model<'_>, object: &Object) -> f64 {
    let away_m = object.votes.iter().map(|&ray| (model.scene.ray(ray).center - object.fit.point).norm());
    away_m.fold(f64::INFINITY, f64::min) * (1.0 - SECTOR_COSINE * SECTOR_COSINE).sqrt()
}

/// How probable it is, in logarithms, that no image of two objects shows both: of those of a camera between where both have begun to be seen and where one is
/// seen no more, any have as many votes of each (Fisher's exact test). None of them is asked where one shows both.
fn ln_never_together(model: &Model<'_>, lookout: &Lookout, [a, b]: [&Object; 2], of: [&[Image]; 2]) -> f64 {
    let drives = |images: &[Image]| images.iter().map(|image| image.drive).collect::<FxHashSet<_>>();
    let [of_a, of_b] = of.map(drives);
    if of_a.is_disjoint(&of_b) {
        return 0.0;
    }
    let size_m = size_of(model, &a.votes, &a.fit.point).exp();
    let near = lookout.around(&a.fit.point, model.classes[a.class as usize].farthest_m);
    let is_of_both = |image: &Image| of_a.contains(&image.drive) && of_b.contains(&image.drive);
    let near = near.map(|row| Image::of(model.scene, row)).filter(is_of_both);
    let mut images: Vec<Image> = near.filter(|image| shows_both(model, a, b, size_m, image.row)).collect();
    images.sort_unstable();
    images.chunk_by(|a, b| a.drive == b.drive).map(|images| ln_apart(images, of)).sum()
}

/// How probable it is, in logarithms, that of the images of a camera, in driving order, none has a vote of both.
fn ln_apart(images: &[Image], of: [&[Image]; 2]) -> f64 {
    let votes =
        |of: &[Image]| -> Vec<usize> { (0..images.len()).filter(|&i| of.binary_search(&images[i]).is_ok()).collect() };
    let [a, b] = of.map(votes);
    let ends = |votes: &[usize]| votes.first().copied().zip(votes.last().copied());
    let (Some(ends_a), Some(ends_b)) = (ends(&a), ends(&b)) else { return 0.0 };
    // Those at which they begin and end are votes by definition.
    let between = ends_a.0.max(ends_b.0) + 1..ends_a.1.min(ends_b.1);
    let [hits_a, hits_b] = [a, b].map(|votes| votes.into_iter().filter(|vote| between.contains(vote)).count());
    let ln_ways = |images: usize| ln_choices(images as f64, hits_b as f64);
    ln_ways(between.len() - hits_a) - ln_ways(between.len())
}

/// Whether an image has both of two things in its picture, near enough to be detected, and neither hides the other. What is nearer than it is large, two
/// things that stand side by side are not. Where nobody knows how large they are, no image does.
fn shows_both(model: &Model<'_>, a: &Object, b: &Object, size_m: f64, image: u32) -> bool {
    let (scene, view) = (model.scene, &model.scene.views[image as usize]);
    let (away, apart) = (a.fit.point - view.center, b.fit.point - a.fit.point);
    let across_m = away.normalize().cross(&apart).norm();
    away.norm() <= model.classes[a.class as usize].farthest_m
        && (apart.norm() < size_m || across_m > HIDING * size_m)
        && scene.is_in_picture(view, &a.fit.point)
        && scene.is_in_picture(view, &b.fit.point)
}

/// An image of a camera on a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Image {
    drive: (u32, u32),
    row: u32,
}

impl Image {
    fn of(scene: &Scene, row: u32) -> Self {
        let view = &scene.views[row as usize];
        Self { drive: (view.pass, view.camera), row }
    }
}

/// The images with votes of an object, ascending.
fn images_of(scene: &Scene, object: &Object) -> Vec<Image> {
    let mut images: Vec<Image> = object.votes.iter().map(|&ray| Image::of(scene, scene.image_of(ray))).collect();
    images.sort_unstable();
    images
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::energy::object;
    use crate::robust::parts::Without;
    use crate::robust::settings::Settings;
    use crate::street::{NOISE, SETTINGS, street};

    const SIGN: Vector3<f64> = Vector3::new(40.0, 2.0, 1.0);

    /// The probabilities that two objects are no copies: a sign, and what is `beside` it, m, by the images that have a vote of each. If it is `shown`, it is
    /// a sign of its own; else its votes are of the first sign as well.
    fn not_copies_of(
        settings: &Settings,
        beside: Vector3<f64>,
        is_shown: bool,
        votes: [&dyn Fn(u32) -> bool; 2],
    ) -> Vec<f64> {
        let signs = [SIGN, SIGN + beside];
        let scene = street(36, 1.0, &signs, &[[0.3, -0.2], [-0.4, 0.1], [0.2, 0.4]]);
        let model = Model::new(&scene, &NOISE, settings);
        let lookout = Lookout::new(&scene, settings.viability.max_range_m);
        let first_of = |image: u32| scene.rays.image.partition_point(|&other| other < image) as u32;
        let of = |number: usize| {
            let shows = u32::from(number == 1 && is_shown);
            let images = (0..36).filter(|&image| votes[number](image));
            let mut begun = object(&model, &lookout, images.map(|image| first_of(image) + shows).collect(), SIGN);
            if let Some(begun) = &mut begun {
                begun.fit.point = signs[number];
            }
            begun
        };
        let objects: Vec<Object> = (0..2).filter_map(of).collect();
        assert!(objects[0].energy < objects[1].energy);
        not_copies(&model, &lookout, &objects)
    }

    const ASIDE: Vector3<f64> = Vector3::new(0.3, 1.2, 0.2);

    fn most(image: u32) -> bool {
        !image.is_multiple_of(3)
    }

    fn others(image: u32) -> bool {
        image.is_multiple_of(3)
    }

    #[test]
    fn what_a_camera_sees_in_turn_with_an_object_is_a_copy_of_it() {
        let both = not_copies_of(&SETTINGS, ASIDE, false, [&most, &others]);
        assert!(both[0] > 0.99 && both[1] < 0.05, "{both:?}");
        let names = ["copies".to_owned()];
        let without = Settings { without: Without::named(&names).unwrap_or_default(), ..SETTINGS };
        assert_eq!(not_copies_of(&without, ASIDE, false, [&most, &others]), [1.0, 1.0]);
    }

    #[test]
    fn what_an_image_shows_beside_it_is_none() {
        let and_one = |image| others(image) || image == 16;
        assert_eq!(not_copies_of(&SETTINGS, ASIDE, true, [&most, &and_one]), [1.0, 1.0]);
    }

    #[test]
    fn what_is_seen_before_it_is_none() {
        let (early, late) = (|image| image < 12, |image| image >= 12);
        assert_eq!(not_copies_of(&SETTINGS, ASIDE, false, [&late, &early]), [1.0, 1.0]);
    }

    #[test]
    fn what_is_missed_at_random_is_none() {
        let few = |image| image % 12 == 3;
        let copy = not_copies_of(&SETTINGS, ASIDE, false, [&|image| image % 12 == 0 || image % 12 == 5, &few])[1];
        assert!(copy > 0.8, "{copy}");
    }

    /// The same for signs every 40 m, of which each sixth image has a vote, and the third one after it one of what is beside the sign.
    fn least_of_many(count: usize) -> f64 {
        let signs: Vec<Vector3<f64>> = (0..count).map(|i| SIGN + Vector3::x() * (40.0 * i as f64)).collect();
        let scene = street(40 * count + 40, 1.0, &signs, &[[0.3, -0.2], [-0.4, 0.1], [0.2, 0.4]]);
        let model = Model::new(&scene, &NOISE, &SETTINGS);
        let lookout = Lookout::new(&scene, SETTINGS.viability.max_range_m);
        let of = |(sign, first): (&Vector3<f64>, u32)| {
            let shows = |&ray: &u32| {
                let seen = scene.ray(ray).project(sign);
                scene.image_of(ray) % 6 == first && seen.xy().norm() < 3.0 * seen.z
            };
            let mut begun = object(&model, &lookout, (0..scene.rays.rays.len() as u32).filter(shows).collect(), *sign)?;
            begun.fit.point = if first == 0 { *sign } else { sign + ASIDE };
            Some(begun)
        };
        let objects: Vec<Object> = signs.iter().flat_map(|sign| [(sign, 0), (sign, 3)]).filter_map(of).collect();
        assert_eq!(objects.len(), 2 * count);
        not_copies(&model, &lookout, &objects).into_iter().fold(1.0, f64::min)
    }

    #[test]
    fn what_may_be_a_copy_is_one_rather_where_all_may_be() {
        let [one, many] = [1, 20].map(least_of_many);
        assert!(one > 0.95 && many < 0.7, "{one} {many}");
    }

    #[test]
    fn what_it_may_hide_is_none() {
        let behind = Vector3::new(6.0, 0.3, 0.15);
        let far = |image| most(image) && image < 20;
        let near = |image| others(image) && image < 20;
        assert_eq!(not_copies_of(&SETTINGS, behind, false, [&far, &near]), [1.0, 1.0]);
    }

    #[test]
    fn what_stands_where_it_stands_is_a_copy_though_it_would_hide_it() {
        let copy = not_copies_of(&SETTINGS, Vector3::new(0.3, 0.1, 0.0), false, [&most, &others])[1];
        assert!(copy < 0.05, "{copy}");
    }
}
