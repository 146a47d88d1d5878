//! Association by global nearest neighbour: which detection shows which object, image by image.
//!
//! All objects compete for all detections. In each image the assignment with the greatest sum of gains wins, with the pose error
//! of the image taken out as far as the votes of its pass tell it. Objects that exchange rays form a group, and a group changes
//! only if J (equations (1) to (5) of `docs/method.md`) falls.

use nalgebra::{Matrix2, SMatrix};
use pathfinding::prelude::{Matrix, kuhn_munkres};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{LEAST_GAIN_OF_MOVE, Object, fitting};
use crate::robust::model::Model;
use crate::robust::noise::drift::Look;
use crate::robust::noise::huber::huber_weight;
use crate::robust::noise::index::{Hit, RayIndex};
use crate::robust::noise::poses::{Belief, PoseError, Segments, smooth};

/// Gains are whole numbers of this part, so that sums do not depend on their order. It is as fine as what a move has to lower J by.
pub const GAIN_UNIT: f64 = 1e-6;

/// A detection that an object may have.
#[derive(Debug, Clone, Copy)]
pub struct Claim {
    /// The image.
    pub image: u32,
    /// The object.
    pub object: u32,
    /// The ray.
    pub ray: u32,
    gain: f64,
}

/// Assign all rays of an index anew; whether anything changed. Objects that are left with too few votes, or that J is lower without,
/// are gone.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn assign(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    objects: Vec<Object>,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let poses = Trajectories::of(model, &objects);
    assign_among(model, lookout, index, &poses, objects, &|_| true, progress)
}

/// The same of the rays that may vote alone; `poses` are what the votes of all objects tell.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn assign_among(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    poses: &Trajectories,
    objects: Vec<Object>,
    may_vote: &(dyn Fn(u32) -> bool + Sync),
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let claims = claims_of_all(model, index, &objects, progress)?;
    let mut by_image: Vec<Claim> = claims.iter().flatten().filter(|claim| may_vote(claim.ray)).copied().collect();
    by_image.par_sort_unstable_by_key(|claim| (claim.image, claim.object, claim.ray));
    let images: Vec<&mut [Claim]> = by_image.chunk_by_mut(|a, b| a.image == b.image).collect();
    let decide = |of_image: &mut [Claim]| {
        progress.check()?;
        let pose = poses.of_image(model, of_image[0].image);
        for claim in of_image.iter_mut() {
            claim.gain = gain(model, &objects[claim.object as usize], claim.ray, &pose);
        }
        Ok(decided(of_image))
    };
    let given: Vec<Vec<(u32, u32)>> = images.into_par_iter().map(decide).collect::<Result<_, Halt>>()?;
    let mut votes: Vec<Vec<u32>> = vec![Vec::new(); objects.len()];
    for (object, ray) in given.into_iter().flatten() {
        votes[object as usize].push(ray);
    }
    for votes in &mut votes {
        votes.sort_unstable();
    }
    commit(model, lookout, objects, &votes, progress)
}

/// Take over what lowers J.
fn commit(
    model: &Model<'_>,
    lookout: &Lookout,
    objects: Vec<Object>,
    votes: &[Vec<u32>],
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let min_votes = model.settings.min_votes;
    let changed = |(i, votes): (usize, &Vec<u32>)| {
        progress.check()?;
        if *votes == objects[i].votes {
            return Ok(Change::None);
        }
        if votes.len() < min_votes {
            return Ok(Change::Death);
        }
        let moved = fitting(model, lookout, votes.clone(), objects[i].fit.point);
        Ok(moved.filter(|moved| moved.energy < 0.0).map_or(Change::Death, |moved| Change::To(Box::new(moved))))
    };
    let changes: Vec<Change> = votes.par_iter().enumerate().map(changed).collect::<Result<_, Halt>>()?;
    // Objects that exchange rays change together or not at all.
    let mut group = Groups::new(objects.len());
    let owners = objects.iter().enumerate().flat_map(|(i, object)| object.votes.iter().map(move |&ray| (ray, i)));
    let owner: FxHashMap<u32, usize> = owners.collect();
    for (i, votes) in votes.iter().enumerate() {
        for ray in votes {
            if let Some(&before) = owner.get(ray) {
                group.join(i, before);
            }
        }
    }
    let mut gain = vec![0.0; objects.len()];
    for (i, change) in changes.iter().enumerate() {
        let delta = match change {
            Change::None => 0.0,
            Change::Death => -objects[i].energy,
            Change::To(moved) => moved.energy - objects[i].energy,
        };
        gain[group.of(i)] += delta;
    }
    let mut any = false;
    let mut kept = Vec::with_capacity(objects.len());
    for (i, (object, change)) in objects.into_iter().zip(changes).enumerate() {
        let falls = gain[group.of(i)] < -LEAST_GAIN_OF_MOVE;
        match change {
            Change::To(moved) if falls => {
                any = true;
                kept.push(*moved);
            }
            Change::Death if falls => any = true,
            _ => kept.push(object),
        }
    }
    Ok((kept, any))
}

/// What becomes of an object.
enum Change {
    None,
    Death,
    To(Box<Object>),
}

/// Union-find.
pub struct Groups(Vec<usize>);

impl Groups {
    /// Everybody alone.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    /// The first of the group of one.
    pub fn of(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }

    /// Make two groups one.
    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.of(a), self.of(b));
        self.0[a.max(b)] = a.min(b);
    }
}

/// The detections that each object may have.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn claims_of_all(
    model: &Model<'_>,
    index: &RayIndex<'_>,
    objects: &[Object],
    progress: &Progress,
) -> Result<Vec<Vec<Claim>>, Halt> {
    let of_object = |(i, object): (usize, &Object)| {
        progress.check()?;
        Ok(claims_of(model, index, i as u32, object))
    };
    objects.par_iter().enumerate().map(of_object).collect()
}

/// The rays in the gate of an object, which has a number among others.
#[must_use]
pub fn claims_of(model: &Model<'_>, index: &RayIndex<'_>, number: u32, object: &Object) -> Vec<Claim> {
    let may_say = |said| model.confusions.may_be(object.class, said);
    let hits = index.hits_of_any(&object.places(model), &may_say, model.reach_m());
    let claim = |hit: Hit| Claim { image: hit.image, object: number, ray: hit.ray, gain: 0.0 };
    hits.into_iter().map(claim).collect()
}

/// What an object gains by a ray over leaving it to clutter; negative infinity outside its gate.
fn gain(model: &Model<'_>, object: &Object, ray: u32, pose: &PoseError) -> f64 {
    let (point, covariance) = object.fit.seen_along(&model.scene.ray(ray).direction);
    let Some(look) = Look::of(model.scene, model.noise, ray, 0, &point) else { return f64::NEG_INFINITY };
    let by_point = SMatrix::<f64, 2, 3>::from_rows(&[look.by_point[0].transpose(), look.by_point[1].transpose()]);
    let own = by_point * covariance * by_point.transpose()
        + Matrix2::identity() * model.noise.detection_px2(model.scene, ray);
    let (residual, covariance) = pose.expected(&look, &own);
    let Some(inverse) = covariance.try_inverse() else { return f64::NEG_INFINITY };
    let chi2 = residual.dot(&(inverse * residual));
    if chi2 > model.settings.gate_chi2() {
        return f64::NEG_INFINITY;
    }
    let depth_m = model.scene.ray(ray).project(&point).z;
    model.votes_for(object.class).gain(ray, chi2, covariance.determinant(), depth_m, object.ln_size)
}

/// What an object gains by a ray if nothing is known of the pose error of its image.
#[must_use]
pub fn gain_alone(model: &Model<'_>, object: &Object, ray: u32) -> f64 {
    let view = model.scene.view(ray);
    gain(model, object, ray, &PoseError::prior(model.noise.shared(view), model.noise.of_image(view)))
}

/// The objects and rays of one image that go together.
fn decided(claims: &[Claim]) -> Vec<(u32, u32)> {
    let open: Vec<&Claim> = claims.iter().filter(|claim| claim.gain > 0.0).collect();
    let is_alone =
        |claim: &Claim| open.iter().filter(|other| other.object == claim.object || other.ray == claim.ray).count() == 1;
    let (alone, contested): (Vec<&Claim>, Vec<&Claim>) = open.iter().copied().partition(|claim| is_alone(claim));
    let mut given: Vec<(u32, u32)> = alone.iter().map(|claim| (claim.object, claim.ray)).collect();
    if contested.is_empty() {
        return given;
    }
    let unique = |of: fn(&Claim) -> u32| {
        let mut all: Vec<u32> = contested.iter().map(|claim| of(claim)).collect();
        all.sort_unstable();
        all.dedup();
        all
    };
    let (objects, rays) = (unique(|claim| claim.object), unique(|claim| claim.ray));
    // Each object may have none: a column of its own without gain.
    let mut gains = Matrix::new(objects.len(), rays.len() + objects.len(), 0_i64);
    for claim in &contested {
        if let (Ok(row), Ok(column)) = (objects.binary_search(&claim.object), rays.binary_search(&claim.ray)) {
            gains[(row, column)] = (claim.gain / GAIN_UNIT) as i64;
        }
    }
    let (_, columns) = kuhn_munkres(&gains);
    for (row, column) in columns.into_iter().enumerate() {
        if column < rays.len() && gains[(row, column)] > 0 {
            given.push((objects[row], rays[column]));
        }
    }
    given
}

/// What the votes of all objects tell about the pose errors along the drives.
pub struct Trajectories {
    segments: Segments,
    /// The drift of each segment.
    smoothed: Vec<Belief>,
    /// What the votes of each image tell of it.
    of_images: FxHashMap<u32, Belief>,
}

impl Trajectories {
    /// Those that all objects tell.
    #[must_use]
    pub fn of(model: &Model<'_>, objects: &[Object]) -> Self {
        let segments = Segments::new(&model.scene.views);
        let of_object = |object: &Object| -> Vec<(u32, Belief)> {
            let image = |ray: u32| model.scene.image_of(ray);
            object.votes.iter().filter_map(|&ray| Some((image(ray), belief_of(model, object, ray)?))).collect()
        };
        let beliefs: Vec<Vec<(u32, Belief)>> = objects.par_iter().map(of_object).collect();
        let mut of_segments = vec![Belief::nothing(); segments.pass.len()];
        let mut of_images: FxHashMap<u32, Belief> = FxHashMap::default();
        for (image, belief) in beliefs.into_iter().flatten() {
            let segment = &mut of_segments[segments.of_view[image as usize] as usize];
            let of_image = of_images.entry(image).or_insert_with(Belief::nothing);
            (*segment, *of_image) = (segment.and(&belief), of_image.and(&belief));
        }
        let mut passes: Vec<(usize, usize)> = Vec::new();
        for segment in 0..segments.pass.len() {
            match passes.last_mut() {
                Some((first, end)) if segments.pass[*first] == segments.pass[segment] => *end = segment + 1,
                _ => passes.push((segment, segment + 1)),
            }
        }
        let smoothed = passes
            .par_iter()
            .flat_map_iter(|&(first, end)| smooth(&segments.start_m[first..end], &of_segments[first..end]));
        let smoothed = smoothed.collect();
        Self { segments, smoothed, of_images }
    }

    /// The pose error of an image, as the votes of other images tell it.
    fn of_image(&self, model: &Model<'_>, image: u32) -> PoseError {
        let view = &model.scene.views[image as usize];
        let smoothed = self.smoothed[self.segments.of_view[image as usize] as usize];
        let belief = self.of_images.get(&image).map_or(smoothed, |own| smoothed.without(own));
        belief.pose_error(model.noise.shared(view), model.noise.of_image(view))
    }
}

/// What a vote says about the drift of its pass.
fn belief_of(model: &Model<'_>, object: &Object, ray: u32) -> Option<Belief> {
    let look = Look::of(model.scene, model.noise, ray, 0, &object.fit.point)?;
    let of_point =
        (0..2).map(|axis| look.by_point[axis].dot(&(object.fit.covariance * look.by_point[axis]))).sum::<f64>() * 0.5;
    let variance = look.variance + of_point;
    let chi2 = (look.residual[0].powi(2) + look.residual[1].powi(2)) / variance;
    let robust = huber_weight(chi2);
    Some(Belief::of_vote(&look, variance / robust))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::energy::anywhere;
    use crate::robust::energy::seen::Seen;
    use crate::robust::energy::sides::{Said, marginalised};
    use crate::robust::energy::unseen;
    use crate::robust::noise::Noise;
    use crate::street;

    #[test]
    fn a_ray_is_asked_for_the_middle_that_its_side_shows() {
        let (point, off_m) = (Vector3::new(20.0, 3.0, 2.0), Vector3::new(0.0, 0.3, 0.0));
        let scene = street::street(4, 1.0, &[point + off_m], &[[0.0, 0.0]]);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let mut object = anywhere(3, Seen::default(), -10.0);
        (object.fit.point, object.fit.covariance) = (point, nalgebra::Matrix3::identity() * 1e-4);
        let pose = PoseError { mean: nalgebra::zero(), covariance: nalgebra::zero() };
        let gain_of_ray = |object: &Object| gain(&model, object, 0, &pose);
        assert!(gain_of_ray(&object) < 0.0, "out of its gate");
        // The side that looks along the street shows another middle.
        let information = nalgebra::Matrix3::identity() * 1e6;
        let say =
            |at: &Vector3<f64>| Some(Said { information, gradient: information * (at - point - off_m), energy: 0.0 });
        object.fit.shown =
            marginalised(1.0, &point, say).map(|(_, middle)| (Vector3::x(), middle)).into_iter().collect();
        assert!(gain_of_ray(&object) > 0.0);
    }

    #[test]
    fn the_pose_of_an_image_is_told_by_the_votes_of_others_whoever_competes_in_it() {
        let at = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(34.0, -4.0, 4.0)];
        let scene = street::street(8, 1.0, &at, &[[1.5, 0.5], [0.5, -1.0], [-2.0, 0.3]]);
        let noise = Noise { position_drift_m: 0.2, ..street::NOISE };
        let model = Model::new(&scene, &noise, &street::SETTINGS);
        let votes = |i: usize| scene.usable_rays().into_iter().skip(i).step_by(2).collect();
        let objects: Vec<Object> = (0..2).filter_map(|i| unseen(&model, votes(i), at[i])).collect();
        let image = 3;
        let mut others = objects.clone();
        for object in &mut others {
            object.votes.retain(|&ray| scene.image_of(ray) != image);
        }
        let [told, expected] = [&objects, &others].map(|all| Trajectories::of(&model, all).of_image(&model, image));
        assert!((told.mean - expected.mean).norm() < 1e-9 && (told.covariance - expected.covariance).norm() < 1e-9);
        let with_own = Trajectories { of_images: FxHashMap::default(), ..Trajectories::of(&model, &objects) };
        assert!((with_own.of_image(&model, image).mean - expected.mean).norm() > 1e-6);
    }
}
