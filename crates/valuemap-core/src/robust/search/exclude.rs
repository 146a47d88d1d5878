//! Exclusion: solid things are not in one place.

use nalgebra::Vector3;

use super::rearrange::{may_be_one, merged};
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, places};
use crate::robust::model::Model;

/// Two objects of a class are no nearer to each other than this share of their size: things are solid, and boxes show their middle to
/// within a fraction of their size. Two objects of real data are half of their size apart (`docs/notes/method.md`).
const EXCLUSIVE_SHARE: f64 = 0.25;
/// Make one of objects that are nearer to each other than solid things can be: a detector that shows one thing twice, or whose boxes have their
/// middle elsewhere from another side, makes no second one.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn exclude(
    model: &Model<'_>,
    lookout: &Lookout,
    mut objects: Vec<Object>,
    progress: &Progress,
) -> Result<Vec<Object>, Halt> {
    loop {
        progress.check()?;
        let points: Vec<Vector3<f64>> = objects.iter().map(|object| object.fit.point).collect();
        let near = too_near(&objects, &points);
        if near.is_empty() {
            return Ok(objects);
        }
        objects = as_one(model, lookout, objects, near);
    }
}

/// Objects of which those of some pairs are one, the first pairs first; the weaker of two that cannot be is left out.
pub(crate) fn as_one(
    model: &Model<'_>,
    lookout: &Lookout,
    objects: Vec<Object>,
    pairs: Vec<(usize, usize)>,
) -> Vec<Object> {
    let mut kept: Vec<Option<Object>> = objects.into_iter().map(Some).collect();
    for (a, b) in pairs {
        let (Some(first), Some(second)) = (&kept[a], &kept[b]) else { continue };
        let (weaker, class) = if first.votes.len() < second.votes.len() { (a, second.class) } else { (b, first.class) };
        // A detector takes one thing for another now and then: the class with more votes has the place.
        let merged = if may_be_one(model, first, second) { merged(model, lookout, [first, second]) } else { None };
        let merged = merged.filter(|merged| merged.class == class && merged.energy < 0.0);
        kept[weaker] = None;
        if let Some(merged) = merged {
            (kept[a], kept[b]) = (None, None);
            kept.push(Some(merged));
        }
    }
    let mut left: Vec<Object> = kept.into_iter().flatten().collect();
    left.sort_by_key(|object| object.votes[0]);
    left
}

/// Pairs of objects at some points that are nearer to each other than solid things can be, the nearest first.
pub(crate) fn too_near(objects: &[Object], points: &[Vector3<f64>]) -> Vec<(usize, usize)> {
    let tree = places::by_place(points.iter().copied());
    let mut near: Vec<(f64, usize, usize)> = Vec::new();
    for (i, (object, point)) in objects.iter().zip(points).enumerate() {
        let reach = EXCLUSIVE_SHARE * object.ln_size.exp();
        if reach.is_finite() {
            let others = tree.locate_within_distance((*point).into(), reach * reach);
            let apart = |other: usize| (points[other] - point).norm();
            near.extend(others.filter(|o| o.data != i).map(|o| (apart(o.data), i.min(o.data), i.max(o.data))));
        }
    }
    near.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    near.into_iter().map(|(_, a, b)| (a, b)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robust::energy::object;
    use crate::street;

    #[test]
    fn of_two_that_no_place_has_room_for_the_stronger_stays_if_both_as_one_are_none() {
        let both = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(30.0, 4.05, 3.0)];
        let scene = street::joined((0..2).map(|_| street::street(10, 2.0, &both, &[[0.2, -0.1]])).collect());
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        // One image shows the second alone.
        let of_first = rays.iter().copied().step_by(2).enumerate().filter(|(image, _)| *image != 3).map(|(_, ray)| ray);
        let votes: [Vec<u32>; 2] = [of_first.collect(), rays.iter().copied().skip(1).step_by(2).take(6).collect()];
        let of = |(votes, at): (Vec<u32>, &Vector3<f64>)| object(&model, &lookout, votes, *at);
        let objects: Vec<Object> = votes.into_iter().zip(&both).filter_map(of).collect();
        let as_one = |model: &Model<'_>| as_one(model, &lookout, objects.clone(), vec![(0, 1)]);
        assert_eq!(as_one(&model).iter().map(|one| one.votes.len()).collect::<Vec<_>>(), [20]);
        // No object is worth its price.
        model.classes[0].ln_clutter_per_sr = 40.0;
        let left = as_one(&model);
        assert_eq!(left.iter().map(|object| &object.votes).collect::<Vec<_>>(), [&objects[0].votes]);
    }
}
