//! Detection rate by viewing angle: how much rarer objects are detected from directions that are farther from those of their votes.
//!
//! Faces turn their backs to some cameras, poles to none. It weighs looks in equation (5) of `docs/method.md`: a miss from where an object may not be seen
//! says less. What an angle says depends on how many votes there are: beside a single vote an object may be seen as far as any is, but between a hundred
//! there is hardly a side left that is seen and has none. So the share of hits is learned by the angle to the nearest of 1, 2, 4 and more votes of the same pass,
//! and to the nearest vote of 1, 2, 4 and more other passes.

use std::f64::consts::PI;

use nalgebra::Vector3;

use super::steps::{BINS, bin};
use crate::robust::scene::{Scene, View};

/// Larger angles are another side, rad: what is seen from there says nothing of here. 15 degrees: looks are within so much of some vote (`SECTOR_COSINE`).
pub const WIDEST_RAD: f64 = PI / 12.0;
/// Directions nearer to each other than this, rad, are one: half of what rates are told apart by.
const SAME_DIRECTION_RAD: f64 = 0.5 * WIDEST_RAD / BINS as f64;
/// From how many votes or passes on: powers of two, to 32. So many across a side are nearer to each other than angles are told apart.
pub const LEVELS: usize = 6;

/// The share of the looks at a class that are hits, over that where it is largest, by the angle to the nearest vote.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aspect {
    /// To the nearest of so many votes of the same pass.
    pub within_pass: [[f64; BINS]; LEVELS],
    /// To the nearest vote of so many passes, where the pass itself has none near.
    pub between_passes: [[f64; BINS]; LEVELS],
}

impl Aspect {
    /// Seen from everywhere.
    pub const ONE: Self = Self { within_pass: [[1.0; BINS]; LEVELS], between_passes: [[1.0; BINS]; LEVELS] };

    /// As many numbers.
    pub const NUMBERS: usize = 2 * LEVELS * BINS;

    /// As numbers, for storage.
    #[must_use]
    pub fn to_row(&self) -> Vec<f64> {
        [self.within_pass, self.between_passes].concat().concat()
    }

    /// What `to_row` returned.
    #[must_use]
    pub fn from_row(row: &[f64; Self::NUMBERS]) -> Self {
        let of = |first: usize| -> [[f64; BINS]; LEVELS] {
            std::array::from_fn(|level| std::array::from_fn(|bin| row[(first + level) * BINS + bin]))
        };
        Self { within_pass: of(0), between_passes: of(LEVELS) }
    }
}

/// Which rates so many votes or passes have.
pub(crate) fn level(count: usize) -> usize {
    (count.max(1).ilog2() as usize).min(LEVELS - 1)
}

/// The directions from which an object is voted for.
pub struct Directions {
    /// By pass, along the drive there, with the viewpoint: one for each.
    of_passes: Vec<Vec<(u32, Vector3<f64>)>>,
    /// The passes, ascending.
    passes: Vec<u32>,
    /// Of all passes, none nearer to another one than `SAME_DIRECTION_RAD`.
    all: Vec<Vector3<f64>>,
}

impl Directions {
    /// Those of some rays (ascending) that vote for a point.
    #[must_use]
    pub fn of(scene: &Scene, point: &Vector3<f64>, voters: &[u32]) -> Self {
        let mut views: Vec<&View> = voters.iter().map(|&ray| scene.view(ray)).collect();
        views.sort_by_key(|view| view.pass);
        views.dedup_by_key(|view| view.viewpoint);
        let direction = |view: &&View| (view.viewpoint, (view.center - point).normalize());
        let of_passes: Vec<Vec<(u32, Vector3<f64>)>> =
            views.chunk_by(|a, b| a.pass == b.pass).map(|pass| pass.iter().map(direction).collect()).collect();
        let mut all: Vec<Vector3<f64>> = Vec::new();
        for (_, direction) in of_passes.iter().flatten() {
            if angle_rad(&all, direction) > SAME_DIRECTION_RAD {
                all.push(*direction);
            }
        }
        let mut passes: Vec<u32> = views.iter().map(|view| view.pass).collect();
        passes.dedup();
        Self { of_passes, passes, all }
    }

    /// How much rarer than at best an object is detected by a camera that looks at it from a direction.
    #[must_use]
    pub fn rate(&self, aspect: &Aspect, pass: u32, direction: &Vector3<f64>) -> f64 {
        if let Ok(own) = self.passes.binary_search(&pass) {
            let own = &self.of_passes[own];
            let within_rad = angle_rad(own.iter().map(|(_, direction)| direction), direction);
            if within_rad <= WIDEST_RAD {
                return aspect.within_pass[level(own.len())][bin(within_rad / WIDEST_RAD)];
            }
        }
        aspect.between_passes[level(self.passes.len())][bin(angle_rad(&self.all, direction) / WIDEST_RAD)]
    }

    /// By level, the angles between the direction of a view and the nearest of so many votes of the same pass but for its own viewpoint, and the nearest
    /// vote of so many other passes, rad; larger than `WIDEST_RAD` where there are not so many. Which ones depends on the viewpoint, so that they are
    /// anywhere.
    pub(crate) fn angles_to_some(&self, view: &View, point: &Vector3<f64>) -> [[f64; 2]; LEVELS] {
        let direction = (view.center - point).normalize();
        let (own, others): (Vec<usize>, Vec<usize>) =
            (0..self.passes.len()).partition(|&pass| self.passes[pass] == view.pass);
        let votes = own.into_iter().flat_map(|pass| &self.of_passes[pass]);
        let votes: Vec<&Vector3<f64>> =
            votes.filter(|(viewpoint, _)| *viewpoint != view.viewpoint).map(|(_, direction)| direction).collect();
        std::array::from_fn(|level| {
            let of_others =
                some(&others, 1 << level, view.viewpoint).into_iter().flat_map(|&pass| &self.of_passes[pass]);
            [
                angle_rad(some(&votes, 1 << level, view.viewpoint).into_iter().copied(), &direction),
                angle_rad(of_others.map(|(_, direction)| direction), &direction),
            ]
        })
    }
}

/// So many of some things, as far from each other as may be, beginning anywhere; none if there are not so many.
fn some<T>(all: &[T], count: usize, anywhere: u32) -> Vec<&T> {
    if all.len() < count {
        return Vec::new();
    }
    (0..count).map(|i| &all[(i * all.len() / count + anywhere as usize) % all.len()]).collect()
}

/// The angle between a direction and the nearest of some others, rad, up to the third order; 2 without any.
fn angle_rad<'a>(others: impl IntoIterator<Item = &'a Vector3<f64>>, direction: &Vector3<f64>) -> f64 {
    let cosine = others.into_iter().map(|other| other.dot(direction)).fold(-1.0, f64::max);
    (2.0 - 2.0 * cosine).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;
    use crate::robust::energy::looks::Lookout;
    use crate::street;

    /// The share of hits falls to nothing at once.
    const FALLING: [f64; BINS] = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];

    #[test]
    fn misses_count_less_the_farther_they_are_from_votes_of_their_pass_or_else_of_others() {
        let at = Vector3::new(40.0, 8.0, 3.0);
        let scene =
            street::joined(vec![street::street(15, 2.0, &[at], &[[0.0; 2]]), street::street(15, 2.0, &[], &[])]);
        let mut model = Model::new(&scene, &street::NOISE, &street::SETTINGS);
        let lookout = Lookout::new(&scene, street::VIABILITY.max_range_m);
        // The first images of the first pass have votes, the last are 20 degrees aside.
        let votes = scene.usable_rays()[..8].to_vec();
        let expected = |model: &Model<'_>| {
            let seen = lookout.looks(model, &at, &votes);
            let of_pass = |pass: usize| seen.sectors[0].get(pass).map_or(0.0, |looks| looks.expected);
            [of_pass(0), of_pass(1)]
        };
        model.classes[0].is_learned = true;
        model.classes[0].farthest_m = 50.0;
        let whole = expected(&model);
        model.classes[0].aspect.within_pass[3] = FALLING;
        let within = expected(&model);
        assert!((8.0..whole[0] - 0.5).contains(&within[0]) && (within[1] - whole[1]).abs() < 1e-12);
        model.classes[0].aspect = Aspect::ONE;
        model.classes[0].aspect.between_passes[0] = FALLING;
        let between = expected(&model);
        assert!((1.0..whole[1] - 0.5).contains(&between[1]) && (between[0] - whole[0]).abs() < 1e-12);
    }

    #[test]
    fn rates_are_those_of_as_many_votes_and_passes() {
        assert_eq!([0, 1, 3, 4, 31, 32, 1000].map(level), [0, 0, 1, 2, 4, 5, 5]);
    }

    #[test]
    fn some_of_all_are_apart_and_anywhere() {
        let all: Vec<usize> = (0..8).collect();
        let [first, next] = [0, 1].map(|anywhere| some(&all, 4, anywhere).into_iter().copied().collect::<Vec<_>>());
        assert_eq!((first, next), (vec![0, 2, 4, 6], vec![1, 3, 5, 7]));
        assert!(some(&all, 9, 0).is_empty());
    }
}
