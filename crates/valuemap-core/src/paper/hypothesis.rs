//! Hypotheses: the 3D points that pairs of detections propose.

use nalgebra::Vector3;

use super::two_view::{self, View};
use crate::progress::{Halt, Progress};
use crate::ray::Ray;
use crate::viability::Viability;

/// A point proposed by two rays (indices of the caller's slice, `a < b`).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// The point.
    pub point: Vector3<f64>,
    /// First ray.
    pub a: u32,
    /// Second ray.
    pub b: u32,
}

/// What became of the pairs: viable ones, and the others by the first test that they failed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PairCounts {
    /// Pairs of rays of different images.
    pub pairs: u64,
    /// Pairs whose rays are too close in angle.
    pub parallax: u64,
    /// Pairs whose rays pass each other too far away.
    pub reprojection: u64,
    /// Pairs that meet behind one of the cameras.
    pub behind: u64,
    /// Pairs that meet too near or too far.
    pub range: u64,
    /// Pairs that propose a point.
    pub hypotheses: u64,
}

impl PairCounts {
    /// Add the counts of another part of the data.
    pub fn add(&mut self, other: &Self) {
        self.pairs += other.pairs;
        self.parallax += other.parallax;
        self.reprojection += other.reprojection;
        self.behind += other.behind;
        self.range += other.range;
        self.hypotheses += other.hypotheses;
    }
}

/// Propose a point for every viable pair of rays of different images; `image` must not decrease.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn propose(
    rays: &[Ray],
    image: &[u32],
    viability: &Viability,
    progress: &Progress,
) -> Result<(Vec<Hypothesis>, PairCounts), Halt> {
    let views: Vec<Option<View>> = rays.iter().map(View::new).collect();
    let max_cosine = viability.min_parallax_rad.cos();
    let mut counts = PairCounts::default();
    let mut hypotheses = Vec::new();
    for (a, ray_a) in rays.iter().enumerate() {
        progress.check()?;
        let later = a + image[a..].partition_point(|&i| i == image[a]);
        for (b, ray_b) in rays.iter().enumerate().skip(later) {
            counts.pairs += 1;
            if !(ray_a.direction.dot(&ray_b.direction) < max_cosine) {
                counts.parallax += 1;
                continue;
            }
            match triangulate((ray_a, &views[a]), (ray_b, &views[b]), viability) {
                Ok(point) => hypotheses.push(Hypothesis { point, a: a as u32, b: b as u32 }),
                Err(Unviable::Behind) => counts.behind += 1,
                Err(Unviable::Range) => counts.range += 1,
                Err(Unviable::Reprojection) => counts.reprojection += 1,
            }
        }
    }
    counts.hypotheses = hypotheses.len() as u64;
    Ok((hypotheses, counts))
}

enum Unviable {
    Behind,
    Range,
    Reprojection,
}

fn triangulate(
    (a, view_a): (&Ray, &Option<View>),
    (b, view_b): (&Ray, &Option<View>),
    viability: &Viability,
) -> Result<Vector3<f64>, Unviable> {
    let (Some(view_a), Some(view_b)) = (view_a, view_b) else { return Err(Unviable::Reprojection) };
    if two_view::miss(view_a, view_b, viability.max_reprojection_error_px) {
        return Err(Unviable::Reprojection);
    }
    let meeting = two_view::meet(view_a, view_b, viability.max_reprojection_error_px).ok_or(Unviable::Reprojection)?;
    if meeting.depth.iter().any(|&depth| depth <= 0.0) {
        return Err(Unviable::Behind);
    }
    let ranges = [a, b].map(|ray| (meeting.point - ray.center).norm());
    if ranges.iter().all(|&range| range >= viability.min_range_m && range <= viability.max_range_m) {
        Ok(meeting.point)
    } else {
        Err(Unviable::Range)
    }
}
