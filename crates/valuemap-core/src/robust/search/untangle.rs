//! Which of two is which: neighbours that have each other's votes of a visit, or from a side.
//!
//! J takes the pose errors of each object for its own. So it hardly tells two objects from the same two with the votes of one visit exchanged: the visit is
//! off by their distance then, one way for the one and the other way for the other. But in an image that shows both, the difference of their detections does
//! not depend on the pose error. It says where the one lies from the other, up to which is which. Pairs of images propose differences of the positions; the
//! one that explains most images says in which images the two have each other's votes.

use nalgebra::{Matrix2x3, Matrix3, Vector2, Vector3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::rearrange::{may_be_one, near_m};
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::is_one_visit;
use crate::robust::energy::looks::{Lookout, SECTOR_COSINE};
use crate::robust::energy::{Object, by_place, by_side, fitting_unseen};
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::scene::Scene;

/// So many images must show both. They have twelve numbers, for the three of a difference and a sign each: three are to spare, as with three votes for a
/// position.
const MIN_IMAGES: usize = 6;
/// Images whose pairs propose how the two lie to each other, at most. It bounds the work: they are 120 pairs with two proposals each.
const PROPOSERS: usize = 16;
/// Images that proposals are tried on, about. It bounds the work: all images judge what comes of the best.
const SAMPLE_IMAGES: usize = 64;
/// Times that the best proposal is fitted to all images that agree with it. It bounds the work: what has not settled then is judged as it is, by all images.
const REFINEMENTS: usize = 3;
/// No image speaks stronger against a proposal. By chance one in 3,000 would (four sigmas on two axes): the others have a vote that is wrong.
const CUT_CHI2: f64 = 16.0;
/// An exchange must lower the sum of squared residuals by so much. Then what they show is more than fifty times as likely (e to the power of half of it).
const LEAST_GAIN: f64 = 8.0;
/// Times that those whose neighbours changed are looked at once more, at most. Three that stand together are three pairs, of which a round exchanges one.
const ROUNDS: usize = 3;

/// How far from each other two may be found that have each other's votes, m: each as far from where it should be as rays that meet crosswise.
#[must_use]
pub fn reach_m(model: &Model<'_>) -> f64 {
    2.0 * near_m(model)
}

/// The objects, with what images say that belongs to the other of two.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn untangle(
    model: &Model<'_>,
    lookout: &Lookout,
    mut objects: Vec<Object>,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    let mut is_open = vec![true; objects.len()];
    for _ in 0..ROUNDS {
        let pairs = pairs(model, &objects, &is_open);
        let try_one = |&(a, b): &(usize, usize)| {
            progress.check()?;
            Ok(exchanged(model, lookout, [&objects[a], &objects[b]]))
        };
        let found: Vec<Option<[Object; 2]>> = pairs.par_iter().map(try_one).collect::<Result<_, Halt>>()?;
        is_open = vec![false; objects.len()];
        for (&(a, b), found) in pairs.iter().zip(found) {
            if let Some([first, second]) = found
                && !is_open[a]
                && !is_open[b]
            {
                (objects[a], objects[b]) = (first, second);
                (is_open[a], is_open[b]) = (true, true);
            }
        }
        if !is_open.contains(&true) {
            break;
        }
    }
    Ok(objects)
}

/// Pairs of objects of which one `is_open`, the nearest first.
fn pairs(model: &Model<'_>, objects: &[Object], is_open: &[bool]) -> Vec<(usize, usize)> {
    let (tree, reach_m) = (by_place(objects), reach_m(model));
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (a, object) in objects.iter().enumerate() {
        let near = tree.locate_within_distance(object.fit.point.into(), reach_m * reach_m).map(|near| near.data);
        let others = near.filter(|&b| b > a && (is_open[a] || is_open[b]) && may_be_one(model, object, &objects[b]));
        pairs.extend(others.map(|b| ((objects[b].fit.point - object.fit.point).norm(), a, b)));
    }
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    pairs.into_iter().map(|(_, a, b)| (a, b)).collect()
}

/// Two objects after an exchange; nothing if they are best as they are. J may rise by no more than the images that show both tell, which J does not know.
fn exchanged(model: &Model<'_>, lookout: &Lookout, of: [&Object; 2]) -> Option<[Object; 2]> {
    let votes = of.map(|object| object.votes.as_slice());
    let exchange = which_is_which(model.scene, model.noise, votes, of.map(|object| object.fit.point), reach_m(model))?;
    let energy = |both: [&Object; 2]| both.iter().map(|object| object.energy).sum::<f64>();
    let object = |(votes, old): (Vec<u32>, &Object)| {
        let found = fitting_unseen(model, votes, old.fit.point)?.with_looks(model, lookout)?;
        (found.energy < 0.0).then_some(found)
    };
    let with = |is_whole_visit: bool| -> Option<[Object; 2]> {
        let [first, second] = all_votes(model.scene, &exchange.shown, votes, is_whole_visit);
        Some([object((first, of[0]))?, object((second, of[1]))?])
    };
    let found = [true, false].into_iter().filter_map(with);
    let best = found.min_by(|a, b| energy(a.each_ref()).total_cmp(&energy(b.each_ref())))?;
    (energy(best.each_ref()) - energy(of) < exchange.gain).then_some(best)
}

/// All votes of each of two after an exchange, ascending. An image that shows one of them alone stays as it is, or goes with the nearest one of its visit.
fn all_votes(scene: &Scene, shown: &[Shown], votes: [&[u32]; 2], is_whole_visit: bool) -> [Vec<u32>; 2] {
    let mut exchanged = votes_of_both(shown);
    for (side, ray) in (0..2).flat_map(|side| votes[side].iter().map(move |&ray| (side, ray))) {
        if shown.iter().any(|both| both.rays[side] == ray) {
            continue;
        }
        let away_m = |both: &&Shown| (scene.view(both.rays[0]).driven_m - scene.view(ray).driven_m).abs();
        let of_visit = shown.iter().filter(|both| is_one_visit(scene.view(both.rays[0]), scene.view(ray)));
        let nearest = of_visit.min_by(|a, b| away_m(a).total_cmp(&away_m(b)));
        let is_other = is_whole_visit && nearest.is_some_and(|both| both.is_other);
        exchanged[side ^ usize::from(is_other)].push(ray);
    }
    for votes in &mut exchanged {
        votes.sort_unstable();
    }
    exchanged
}

/// What the images that show both of two say.
#[derive(Debug, Clone, PartialEq)]
pub struct Exchange {
    /// The images.
    pub shown: Vec<Shown>,
    /// By how much less is unexplained than with the votes as they are, squared sigmas.
    pub gain: f64,
}

/// The votes of two in an image that shows both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// As they are.
    pub rays: [u32; 2],
    /// Whether each is the other's.
    pub is_other: bool,
}

/// The votes of each of two in the images that show both, after the exchange.
#[must_use]
pub fn votes_of_both(shown: &[Shown]) -> [Vec<u32>; 2] {
    [0, 1].map(|side| shown.iter().map(|both| both.rays[side ^ usize::from(both.is_other)]).collect())
}

/// In which of the images that show both of two, with votes (ascending) and points, no farther apart than `reach_m`, they have each other's votes; nothing if
/// they are best as they are.
#[must_use]
pub fn which_is_which(
    scene: &Scene,
    noise: &Noise,
    votes: [&[u32]; 2],
    points: [Vector3<f64>; 2],
    reach_m: f64,
) -> Option<Exchange> {
    let images = images_of_both(scene, noise, votes, &((points[0] + points[1]) * 0.5))?;
    if images.len() < MIN_IMAGES {
        return None;
    }
    let now = points[0] - points[1];
    let unswapped: f64 = images.iter().map(|both| both.chi2(&now)[0].min(CUT_CHI2)).sum();
    // None is explained better than by no residual at all.
    if unswapped < LEAST_GAIN {
        return None;
    }
    let mut starts = flipped(&images, reach_m);
    starts.push(proposed(&images, &now, reach_m));
    let refined = starts
        .iter()
        .filter_map(|start| (0..REFINEMENTS).try_fold(*start, |apart, _| refined(&images, &apart, reach_m)));
    let (least, apart) = refined.map(|apart| (cost(&images, 1, &apart), apart)).min_by(|a, b| a.0.total_cmp(&b.0))?;
    if !(least < unswapped - LEAST_GAIN) {
        return None;
    }
    let swapped: Vec<bool> = images.iter().map(|both| both.chi2(&apart)).map(|[as_is, swap]| swap < as_is).collect();
    // Which is which is free to choose: so that fewer votes change sides.
    let mirrored = 2 * swapped.iter().filter(|&&swap| swap).count() > swapped.len();
    if swapped.iter().all(|&swap| swap == mirrored) {
        return None;
    }
    let shown = |(both, swap): (&Both, bool)| Shown { rays: both.rays, is_other: swap != mirrored };
    Some(Exchange { shown: images.iter().zip(swapped).map(shown).collect(), gain: unswapped - least })
}

/// Both votes of an image that shows both, and what their difference says.
struct Both {
    rays: [u32; 2],
    /// Unit direction from the two to the camera.
    direction: Vector3<f64>,
    /// Difference of the residuals at a common point, px: that of the positions, seen from the image, if each ray is its own.
    difference: Vector2<f64>,
    /// By the difference of the positions, px/m.
    by_point: Matrix2x3<f64>,
    /// Variance of the difference, each axis, px².
    variance: f64,
}

impl Both {
    /// Squared residual in sigmas if the two are this far apart, as the rays are and swapped.
    fn chi2(&self, apart: &Vector3<f64>) -> [f64; 2] {
        let expected = self.by_point * apart;
        [1.0, -1.0].map(|sign| (self.difference * sign - expected).norm_squared() / self.variance)
    }
}

/// The images in which both have a vote, by pass.
fn images_of_both(scene: &Scene, noise: &Noise, [a, b]: [&[u32]; 2], middle: &Vector3<f64>) -> Option<Vec<Both>> {
    let image = |ray: u32| scene.image_of(ray);
    let of_b: FxHashMap<u32, u32> = b.iter().map(|&ray| (image(ray), ray)).collect();
    let shown = a.iter().filter_map(|&ray| of_b.get(&image(ray)).map(|&other| [ray, other]));
    shown
        .map(|rays| {
            let (residual_a, rows) = scene.ray(rays[0]).linearize(middle)?;
            let (residual_b, _) = scene.ray(rays[1]).linearize(middle)?;
            Some(Both {
                rays,
                direction: (scene.ray(rays[0]).center - middle).normalize(),
                difference: Vector2::from(residual_b) - Vector2::from(residual_a),
                by_point: Matrix2x3::from_rows(&rows),
                variance: noise.detection_px2(scene, rays[0]) + noise.detection_px2(scene, rays[1]),
            })
        })
        .collect()
}

/// The differences of the positions if the votes of all images that look from one side are swapped.
fn flipped(images: &[Both], reach_m: f64) -> Vec<Vector3<f64>> {
    let sides = by_side((0..).zip(images).map(|(i, both)| (i, both.direction)), SECTOR_COSINE);
    let flip = |side: &Vec<u32>| {
        let sign = |i: u32| if side.binary_search(&i).is_ok() { -1.0 } else { 1.0 };
        solve((0..).zip(images).map(|(i, both)| (both, sign(i))), reach_m)
    };
    sides.iter().filter_map(flip).collect()
}

/// The difference of the positions that fits a sample of the images best, of those that pairs of images would have.
fn proposed(images: &[Both], now: &Vector3<f64>, reach_m: f64) -> Vector3<f64> {
    let stride = images.len().div_ceil(SAMPLE_IMAGES);
    let all =
        std::iter::once(*now).chain(proposals(images, reach_m)).map(|apart| (cost(images, stride, &apart), apart));
    all.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(*now, |(_, apart)| apart)
}

/// Differences of the positions that pairs of images would have.
fn proposals(images: &[Both], reach_m: f64) -> Vec<Vector3<f64>> {
    let sample: Vec<&Both> = images.iter().step_by(images.len().div_ceil(PROPOSERS)).collect();
    let mut proposals = Vec::new();
    for (i, first) in sample.iter().enumerate() {
        for second in &sample[i + 1..] {
            proposals.extend(
                [1.0, -1.0].iter().filter_map(|&sign| solve([(*first, 1.0), (*second, sign)].into_iter(), reach_m)),
            );
        }
    }
    proposals
}

/// The difference of the positions that fits best if the images are swapped as it says.
fn refined(images: &[Both], apart: &Vector3<f64>, reach_m: f64) -> Option<Vector3<f64>> {
    let fitting = images.iter().filter_map(|both| {
        let [as_is, swap] = both.chi2(apart);
        (as_is.min(swap) < CUT_CHI2).then_some((both, if swap < as_is { -1.0 } else { 1.0 }))
    });
    solve(fitting, reach_m)
}

/// Least squares, with a weak prior for what the images do not tell.
fn solve<'a>(images: impl Iterator<Item = (&'a Both, f64)>, reach_m: f64) -> Option<Vector3<f64>> {
    let mut information = Matrix3::identity() / (reach_m * reach_m);
    let mut sum = Vector3::zeros();
    for (both, sign) in images {
        information += both.by_point.transpose() * both.by_point / both.variance;
        sum += both.by_point.transpose() * both.difference * (sign / both.variance);
    }
    Some(information.cholesky()?.solve(&sum))
}

fn cost(images: &[Both], stride: usize, apart: &Vector3<f64>) -> f64 {
    let of_image = |both: &Both| {
        let [as_is, swap] = both.chi2(apart);
        as_is.min(swap).min(CUT_CHI2)
    };
    images.iter().step_by(stride).map(of_image).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;
    use crate::robust::energy::object;
    use crate::street::{NOISE, SETTINGS, joined, moved, street};

    /// Two beside each other, half a metre apart, as three drives see them of which each is off by some decimetres.
    fn drives(at: &[Vector3<f64>]) -> Scene {
        let errors: Vec<[f64; 2]> = (0..97).map(|i| [(f64::from(i) * 1.7).sin(), (f64::from(i) * 2.3).cos()]).collect();
        let drive = |i: u8| {
            let [x, y] = [(f64::from(i) * 2.1).sin(), (f64::from(i) * 1.3).cos()].map(|off| 0.3 * off);
            moved(street(20, 2.0, at, &errors), &Isometry3::translation(x, y, 0.0))
        };
        joined((0..3).map(drive).collect())
    }

    /// What is found of the two that have each other's votes of some images, without some rays; and what should be.
    fn untangled(swapped: &[u32], missing: &[u32]) -> Result<[Vec<Vec<u32>>; 2], Halt> {
        let at = [Vector3::new(45.0, 4.0, 3.0), Vector3::new(45.0, 4.5, 3.0)];
        let scene = drives(&at);
        let noise = Noise { position_drift_m: 0.3, ..NOISE };
        let model = Model::new(&scene, &noise, &SETTINGS);
        let lookout = Lookout::new(&scene, SETTINGS.viability.max_range_m);
        let votes = |one: u32, swapped: &[u32]| -> Vec<u32> {
            let is_its = |ray: &u32| ray % 2 == (one + u32::from(swapped.contains(&(ray / 2)))) % 2;
            scene.usable_rays().into_iter().filter(|ray| !missing.contains(ray)).filter(is_its).collect()
        };
        let place = |one: u32| object(&model, &lookout, votes(one, swapped), at[one as usize]);
        let found = untangle(&model, &lookout, (0..2).filter_map(place).collect(), &Progress::default())?;
        let found = found.into_iter().map(|object| object.votes).collect();
        Ok([found, vec![votes(0, &[]), votes(1, &[])]])
    }

    /// The images of the second drive, each of which shows both.
    const SECOND: std::ops::Range<u32> = 20..40;

    #[test]
    fn a_visit_of_which_two_have_each_others_votes_is_put_right() -> Result<(), Halt> {
        for swapped in [Vec::new(), SECOND.collect()] {
            let [found, right] = untangled(&swapped, &[])?;
            assert_eq!(found, right);
        }
        Ok(())
    }

    #[test]
    fn an_image_that_shows_one_of_two_alone_goes_with_the_nearest_of_its_visit() -> Result<(), Halt> {
        let [found, right] = untangled(&SECOND.collect::<Vec<u32>>(), &[51, 58])?;
        assert_eq!(found, right);
        Ok(())
    }

    #[test]
    fn images_that_show_one_of_two_alone_do_not_go_with_one_that_was_wrong_by_itself() -> Result<(), Halt> {
        // From the ninth image on, the second drive shows the first of them alone.
        let missing: Vec<u32> = SECOND.skip(8).map(|image| 2 * image + 1).collect();
        let [found, right] = untangled(&[27], &missing)?;
        assert_eq!(found, right);
        Ok(())
    }
}
