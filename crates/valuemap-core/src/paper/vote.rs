//! Algorithm 1 for all clusters: propose, vote, select, refine.

use std::ops::Range;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::ballot::Ballot;
use super::hypothesis::{self, PairCounts};
use super::select::{self, Stop};
use super::triangulate;
use crate::progress::{Halt, Progress};
use crate::ray::{Ray, Rays};
use crate::viability::Viability;

/// An accepted point with its voters.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Refined position in the world, m.
    pub point: Vector3<f64>,
    /// The clusters it was found in, ascending.
    pub clusters: Vec<u32>,
    /// Indices of the rays that support it, ascending.
    pub voters: Vec<u32>,
}

/// Run Algorithm 1 in every cluster, each class for itself.
///
/// `cluster` is the cluster of each ray. Candidates come ordered by their first voter; `progress` advances once
/// a cluster and class.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so, [`Halt::TooLarge`] for a cluster beyond memory.
pub fn vote(
    rays: &Rays,
    cluster: &[u32],
    viability: &Viability,
    stop: &Stop,
    progress: &Progress,
) -> Result<(Vec<Candidate>, PairCounts), Halt> {
    let (order, units) = units(rays, cluster);
    let found = units
        .into_par_iter()
        .with_max_len(1) // The large ones come first: a thread that takes several at once would have all the work.
        .map(|unit| {
            let members = &order[unit];
            let found = vote_in_cluster(rays, members, viability, stop, progress)?;
            progress.advance()?;
            Ok((cluster[members[0] as usize], found))
        })
        .collect::<Result<Vec<_>, Halt>>()?;
    let mut counts = PairCounts::default();
    let mut candidates = Vec::new();
    for (cluster, (points, of_cluster)) in found {
        counts.add(&of_cluster);
        candidates.extend(points.into_iter().map(|(point, voters)| Candidate {
            point,
            clusters: vec![cluster],
            voters,
        }));
    }
    candidates.sort_by_key(|candidate| candidate.voters[0]);
    Ok((candidates, counts))
}

/// How many units of work [`vote`] reports to its progress.
#[must_use]
pub fn count_units(rays: &Rays, cluster: &[u32]) -> usize {
    units(rays, cluster).1.len()
}

/// Rays ordered by cluster, class, image and id, and the range of each cluster and class, the largest first so
/// that no thread is left with a large one at the end.
fn units(rays: &Rays, cluster: &[u32]) -> (Vec<u32>, Vec<Range<usize>>) {
    let key = |&ray: &u32| (cluster[ray as usize], rays.class[ray as usize]);
    let mut order: Vec<u32> = (0..cluster.len() as u32).collect();
    order.sort_by_key(|ray| (key(ray), rays.image[*ray as usize], *ray));
    let mut start = 0;
    let mut units: Vec<Range<usize>> = order
        .chunk_by(|a, b| key(a) == key(b))
        .map(|unit| {
            start += unit.len();
            start - unit.len()..start
        })
        .collect();
    units.sort_by_key(|unit| (std::cmp::Reverse(unit.len()), unit.start));
    (order, units)
}

type Found = (Vec<(Vector3<f64>, Vec<u32>)>, PairCounts);

fn vote_in_cluster(
    all: &Rays,
    members: &[u32],
    viability: &Viability,
    stop: &Stop,
    progress: &Progress,
) -> Result<Found, Halt> {
    let origin = all.rays[members[0] as usize].center;
    let rays: Vec<Ray> = members.iter().map(|&ray| all.rays[ray as usize].relative_to(&origin)).collect();
    let image: Vec<u32> = members.iter().map(|&ray| all.image[ray as usize]).collect();
    let (hypotheses, counts) = hypothesis::propose(&rays, &image, viability, progress)?;
    let points: Vec<Vector3<f64>> = hypotheses.iter().map(|hypothesis| hypothesis.point).collect();
    let ballot = Ballot::cast(&points, &rays, &image, viability.max_reprojection_error_px, progress)?;
    let found = select::select(&hypotheses, &rays, &image, ballot, stop, progress)?
        .into_iter()
        .map(|winner| {
            let start = hypotheses[winner.hypothesis].point;
            let point = triangulate::refine(&winner.voters.iter().map(|&ray| &rays[ray]), start).unwrap_or(start);
            let mut voters: Vec<u32> = winner.voters.iter().map(|&ray| members[ray]).collect();
            voters.sort_unstable();
            (point + origin, voters)
        })
        .collect();
    Ok((found, counts))
}
