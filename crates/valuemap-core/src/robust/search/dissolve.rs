//! Dissolution: an object is removed and its votes go to neighbours that show nothing else in their images, if that lowers J.
//!
//! What stands between two objects with votes of both ends here, and what pose errors have put beside the object that it is.

use rayon::prelude::*;

use super::assign::{Claim, claims_of_all, gain_alone};
use crate::progress::{Halt, Progress};
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{LEAST_GAIN_OF_MOVE, NOBODY, Object, fitting, owners};
use crate::robust::model::Model;
use crate::robust::noise::index::RayIndex;

/// Neighbours must want this share of an object's votes: no more may be lost than go on. It spares trials, since J decides.
const LEAST_WANTED: f64 = 0.5;

/// A vote that another object may have, and what that one gains by it.
struct Wanted {
    of: usize,
    ray: u32,
    by: usize,
    gain: f64,
}

/// What is there once an object is dissolved.
struct Dissolved {
    of: usize,
    change: f64,
    heirs: Vec<(usize, Object)>,
}

/// Dissolve objects as long as J falls; whether it did.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn dissolve(
    model: &Model<'_>,
    lookout: &Lookout,
    index: &RayIndex<'_>,
    mut objects: Vec<Object>,
    progress: &Progress,
) -> Result<(Vec<Object>, bool), Halt> {
    let mut any = false;
    loop {
        let wanted = wanted(model, index, &objects, progress)?;
        let of_objects: Vec<&[Wanted]> = wanted.chunk_by(|a, b| a.of == b.of).collect();
        let try_one = |wanted: &&[Wanted]| {
            progress.check()?;
            Ok(dissolved(model, lookout, &objects, wanted))
        };
        let found: Vec<Option<Dissolved>> = of_objects.par_iter().map(try_one).collect::<Result<_, Halt>>()?;
        let mut better: Vec<Dissolved> = found.into_iter().flatten().collect();
        if better.is_empty() {
            return Ok((objects, any));
        }
        any = true;
        better.sort_by(|a, b| a.change.total_cmp(&b.change).then(a.of.cmp(&b.of)));
        let mut is_open = vec![true; objects.len()];
        let mut kept: Vec<Option<Object>> = objects.into_iter().map(Some).collect();
        for Dissolved { of, heirs, .. } in better {
            if is_open[of] && heirs.iter().all(|(heir, _)| is_open[*heir]) {
                (kept[of], is_open[of]) = (None, false);
                for (heir, object) in heirs {
                    (kept[heir], is_open[heir]) = (Some(object), false);
                }
            }
        }
        objects = kept.into_iter().flatten().collect();
        objects.sort_by_key(|object| object.votes[0]);
    }
}

/// The votes of each object that another one gains by which has none in their images, each by the one that gains most; by object, then by ray.
fn wanted(
    model: &Model<'_>,
    index: &RayIndex<'_>,
    objects: &[Object],
    progress: &Progress,
) -> Result<Vec<Wanted>, Halt> {
    let image = |ray: &u32| model.scene.image_of(*ray);
    let owner = owners(model.scene, objects);
    let claims = claims_of_all(model, index, objects, progress)?;
    let by_object = |(by, claims): (usize, &Vec<Claim>)| -> Vec<Wanted> {
        let wants = |claim: &Claim| {
            let of = owner[claim.ray as usize];
            let is_theirs = of != NOBODY && of as usize != by;
            if !is_theirs || objects[by].votes.binary_search_by_key(&claim.image, image).is_ok() {
                return None;
            }
            let gain = gain_alone(model, &objects[by], claim.ray);
            (gain > 0.0).then_some(Wanted { of: of as usize, ray: claim.ray, by, gain })
        };
        claims.iter().filter_map(wants).collect()
    };
    let mut wanted: Vec<Wanted> = claims.par_iter().enumerate().flat_map_iter(by_object).collect();
    wanted.sort_by(|a, b| (a.of, a.ray).cmp(&(b.of, b.ray)).then(b.gain.total_cmp(&a.gain)).then(a.by.cmp(&b.by)));
    wanted.dedup_by_key(|wanted| wanted.ray);
    Ok(wanted)
}

/// What is there once the object is dissolved of whose votes these are wanted, if J is lower then.
fn dissolved(model: &Model<'_>, lookout: &Lookout, objects: &[Object], wanted: &[Wanted]) -> Option<Dissolved> {
    let of = wanted[0].of;
    if (wanted.len() as f64) < LEAST_WANTED * objects[of].votes.len() as f64 {
        return None;
    }
    let mut by: Vec<usize> = wanted.iter().map(|wanted| wanted.by).collect();
    by.sort_unstable();
    by.dedup();
    let richer = |heir: usize| {
        let mut votes = objects[heir].votes.clone();
        votes.extend(wanted.iter().filter(|wanted| wanted.by == heir).map(|wanted| wanted.ray));
        votes.sort_unstable();
        Some((heir, fitting(model, lookout, votes, objects[heir].fit.point)?))
    };
    let heirs: Vec<(usize, Object)> = by.into_iter().map(richer).collect::<Option<_>>()?;
    let of_heirs: f64 = heirs.iter().map(|(heir, object)| object.energy - objects[*heir].energy).sum();
    let change = of_heirs - objects[of].energy;
    (change < -LEAST_GAIN_OF_MOVE).then_some(Dissolved { of, change, heirs })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::robust::energy::object;
    use crate::street;

    const AT: [Vector3<f64>; 2] = [Vector3::new(30.0, 4.0, 3.0), Vector3::new(30.0, 5.0, 3.0)];

    /// The votes of what is left of the objects that have votes as a function of image and of which of two things they show says.
    fn left(owner: impl Fn(u32, usize) -> usize) -> Result<Vec<Vec<u32>>, Halt> {
        let scene = street::street(12, 2.0, &AT, &[[0.5, 0.2], [-0.3, 0.4], [0.1, -0.6]]);
        let model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        let rays = scene.usable_rays();
        let index = RayIndex::new(&scene, &model.spreads, street::GATE_SIGMAS, rays.iter().copied());
        let mut votes: Vec<Vec<u32>> = vec![Vec::new(); 3];
        for &ray in &rays {
            let shows = usize::from(scene.ray(ray).squared_error(&AT[1]) < scene.ray(ray).squared_error(&AT[0]));
            votes[owner(scene.image_of(ray), shows)].push(ray);
        }
        let middle = 0.5 * (AT[0] + AT[1]);
        let starts = [AT[0], AT[1], middle];
        let of = |(votes, start)| object(&model, &lookout, votes, start);
        let objects: Vec<Object> = votes.into_iter().zip(starts).filter_map(of).collect();
        let (objects, _) = dissolve(&model, &lookout, &index, objects, &Progress::default())?;
        Ok(objects.into_iter().map(|object| object.votes).collect())
    }

    #[test]
    fn what_has_votes_of_two_objects_gives_them_back_and_these_stay_two() -> Result<(), Halt> {
        let two = left(|_, shows| shows)?;
        assert_eq!(two.iter().map(Vec::len).collect::<Vec<_>>(), [12, 12]);
        let between = |image: u32, shows: usize| if image % 4 == 2 * shows as u32 { 2 } else { shows };
        assert_eq!(left(between)?, two);
        Ok(())
    }

    #[test]
    fn an_object_that_is_torn_becomes_one() -> Result<(), Halt> {
        let torn = left(|image, shows| if shows == 0 && image % 2 == 1 { 2 } else { shows })?;
        assert_eq!(torn, left(|_, shows| shows)?);
        Ok(())
    }
}
