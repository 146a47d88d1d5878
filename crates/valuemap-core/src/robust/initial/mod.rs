//! The initial map: where the search begins, found fast by rules and not by J.
//!
//! Labels are gathered from proposals ([`gather`]), compete for detections ([`associate`], [`assignment`], [`rivals`]), are estimated together by place
//! ([`adjust`]), exchange votes with neighbours ([`exchange`](mod@exchange)), merge and split ([`settle`]), and are dropped where J is lower
//! without them. In large scenes keyframes go first.

pub mod adjust;
pub mod assignment;
pub mod associate;
pub mod exchange;
pub mod gather;
pub mod keyframes;
pub mod label;
pub mod pairs;
pub mod rivals;
pub mod settle;
mod solver;

use crate::progress::{Halt, Progress};
use crate::robust::energy::Placed;
use crate::robust::model::Model;
use keyframes::Keyframes;
use label::Label;
use solver::Solver;

/// How labels are found among the rays of a scene.
struct Schedule {
    /// Times that the rays of no label are gathered, at most: what is left over gets less and less.
    gatherings: usize,
    /// Times that labels compete before any is pruned.
    rounds: usize,
    /// Whether labels whose sides disagree are split: what is split in vain has to be merged by J, which takes all moves.
    splits: bool,
}

/// For all images of a scene. Gatherings bound the work: they end where nothing more is found. Cities of two passes lose 0.2 % of their objects with one.
const WHOLE: Schedule = Schedule { gatherings: 3, rounds: 4, splits: true };
/// For the keyframes of a large one. What is left over is gathered in all images afterwards, so that once is enough.
const KEYFRAMES: Schedule = Schedule { gatherings: 1, splits: false, ..WHOLE };
/// For all its images, when labels competed in the keyframes. One round instead of two spares 5 % of the time and loses precision.
const REFINING: Schedule = Schedule { gatherings: 1, rounds: 2, splits: false };

/// What became of everything that was proposed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Points proposed by rays.
    pub nominations: u64,
    /// Nominations that were polished to labels.
    pub accepted: u64,
    /// Labels that lost too many votes to others.
    pub outvoted: u64,
    /// Labels that J is lower without.
    pub pruned: u64,
}

/// Labels of some rays (ascending) alone, quickly.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn labels_of_few(model: &Model<'_>, rays: &[u32], progress: &Progress) -> Result<Vec<Placed>, Halt> {
    let (mut labels, _) = gather::gather(model, rays, progress)?;
    let mut solver = Solver::new(model, rays.iter().copied());
    for _ in 0..WHOLE.rounds {
        labels = solver.settle(labels, WHOLE.splits, &mut Tally::default(), progress)?;
    }
    Ok(labels.iter().map(placed).collect())
}

/// The labels of a scene, and how it came to them; those of a part of the images decide which there are if it `is_quick`.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn labels(model: &Model<'_>, is_quick: bool, progress: &Progress) -> Result<(Vec<Placed>, Tally), Halt> {
    let mut tally = Tally::default();
    let keyframes = is_quick.then(|| Keyframes::of(model.scene)).flatten();
    let first = match &keyframes {
        Some(keyframes) => {
            let thinned = Model::new(&keyframes.scene, model.noise, model.settings).knowing(model);
            let mut solver = Solver::new(&thinned, 0..keyframes.scene.rays.rays.len() as u32);
            let labels = solver.solve(Vec::new(), &KEYFRAMES, &mut tally, progress)?;
            labels.into_iter().map(|label| keyframes.in_whole(label)).collect()
        }
        None => Vec::new(),
    };
    let schedule = if keyframes.is_some() { REFINING } else { WHOLE };
    let mut solver = Solver::new(model, 0..model.scene.rays.rays.len() as u32);
    let labels = solver.solve(first, &schedule, &mut tally, progress)?;
    Ok((labels.iter().map(placed).collect(), tally))
}

/// The votes (ascending) and the position of a label.
fn placed(label: &Label) -> Placed {
    let mut votes = label.voters.clone();
    votes.sort_unstable();
    (votes, label.estimate.point)
}
