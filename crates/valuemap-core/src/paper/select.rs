//! The greedy selection: the best supported hypothesis wins, its voters leave, and again.

use super::ballot::Ballot;
use super::hypothesis::Hypothesis;
use crate::progress::{Halt, Progress};
use crate::ray::Ray;

/// When the selection stops.
#[derive(Debug, Clone, Copy)]
pub struct Stop {
    /// A winner needs at least this multiple of the mean votes of the hypotheses that are still alive (`alpha`).
    pub min_vote_ratio: f64,
    /// A winner needs at least this many votes.
    pub min_votes: u32,
}

/// An accepted hypothesis: its index, and the rays that voted for it (ascending, one an image).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Winner {
    /// Index of the hypothesis.
    pub hypothesis: usize,
    /// Indices of the rays.
    pub voters: Vec<usize>,
}

/// Select winners until support is too thin; lines 9 to 13 of Algorithm 1.
///
/// A hypothesis is alive while both rays that proposed it are. Taking rays away can only lower votes, so the votes
/// are updated, not counted anew. Ties go to the smaller summed squared residual, then to the lower rays.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn select(
    hypotheses: &[Hypothesis],
    rays: &[Ray],
    image: &[u32],
    mut ballot: Ballot,
    stop: &Stop,
    progress: &Progress,
) -> Result<Vec<Winner>, Halt> {
    let mut votes: Vec<u32> = (0..hypotheses.len()).map(|h| ballot.votes(h)).collect();
    let mut alive: Vec<usize> = (0..hypotheses.len()).collect();
    let mut winners = Vec::new();
    let mut gone = vec![false; rays.len()];
    while let Some(most) = alive.iter().map(|&h| votes[h]).max() {
        progress.check()?;
        let total: u64 = alive.iter().map(|&h| u64::from(votes[h])).sum();
        let mean = total as f64 / alive.len() as f64;
        if most < stop.min_votes || f64::from(most) < stop.min_vote_ratio * mean {
            break;
        }
        let tied = alive.iter().copied().filter(|&h| votes[h] == most);
        let Some(winner) = best_of(tied, hypotheses, rays, image, &ballot) else { break };
        for &ray in &winner.voters {
            gone[ray] = true;
        }
        let bits = ballot.bits_of(&winner.voters);
        alive.retain(|&h| {
            if gone[hypotheses[h].a as usize] || gone[hypotheses[h].b as usize] {
                return false;
            }
            if ballot.remove(h, &bits) {
                votes[h] = ballot.votes(h);
            }
            true
        });
        winners.push(winner);
    }
    Ok(winners)
}

fn best_of(
    tied: impl Iterator<Item = usize>,
    hypotheses: &[Hypothesis],
    rays: &[Ray],
    image: &[u32],
    ballot: &Ballot,
) -> Option<Winner> {
    let mut best: Option<(f64, Winner)> = None;
    for h in tied {
        let (voters, cost) = voters_of(&hypotheses[h], rays, image, ballot.rays(h));
        // Hypotheses come in ascending order of their rays, so the first of equals has the lowest.
        if best.as_ref().is_none_or(|(least, _)| cost < *least) {
            best = Some((cost, Winner { hypothesis: h, voters }));
        }
    }
    best.map(|(_, winner)| winner)
}

/// The closest ray of each image among `in_gate` (ascending), and the sum of their squared residuals.
fn voters_of(
    hypothesis: &Hypothesis,
    rays: &[Ray],
    image: &[u32],
    in_gate: impl Iterator<Item = usize>,
) -> (Vec<usize>, f64) {
    let mut voters: Vec<usize> = Vec::new();
    let mut errors: Vec<f64> = Vec::new();
    for ray in in_gate {
        let error = rays[ray].squared_error(&hypothesis.point);
        match (voters.last_mut(), errors.last_mut()) {
            (Some(voter), Some(least)) if image[*voter] == image[ray] => {
                if error < *least {
                    (*voter, *least) = (ray, error);
                }
            }
            _ => {
                voters.push(ray);
                errors.push(error);
            }
        }
    }
    (voters, errors.iter().sum())
}
