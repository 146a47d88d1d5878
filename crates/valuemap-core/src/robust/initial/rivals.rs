//! Rivals: two labels of which a pass shows only one, and it might be either.
//!
//! There is then one object, and one of the labels is not visible from there. All that the pass shows of the two together decides
//! which, with the drift of the pass as its other labels tell it.

use rustc_hash::{FxHashMap, FxHashSet};

use super::assignment::{Fit, assigned, belief_of_votes, open};
use super::associate::Run;
use crate::progress::{Halt, Progress};
use crate::robust::noise::Sigmas;
use crate::robust::noise::drift::{Drive, Look};
use crate::robust::noise::poses::{PoseError, SEGMENTS_AROUND, smooth};

/// Images of a pass that show one of two labels, which may be either, before it is concluded that there is but one. Two objects that are seen in half of the
/// images each show both in none of eight in 4 % of the cases.
const LEAST_RIVALRY: u32 = 8;
/// For each of them, images that show both, at most: what clutter and double detections do.
const MOST_BOTH: f64 = 0.1;

/// What one pass shows of two labels that claim the same detections.
#[derive(Default)]
struct Rivalry {
    /// Images that show both.
    both: u32,
    /// Images that show one of them, which may be either.
    one: u32,
    /// These images, as numbered in the pass, and what they show.
    rays: Vec<(usize, u32)>,
}

impl Run<'_> {
    /// Pairs of labels (the better one, the other) of which a pass shows only one, where it might be either: there is one
    /// object, and the other label is not to be seen from there.
    pub(super) fn overruled(&self, fits: &[Vec<Fit>], progress: &Progress) -> Result<FxHashSet<(u32, u32)>, Halt> {
        let mut rivalries = self.rivalries(fits, progress)?;
        if rivalries.is_empty() {
            return Ok(FxHashSet::default());
        }
        for (cases, fits) in self.images.iter().zip(fits) {
            let assigned: Vec<u32> = assigned(cases, fits).map(|claim| claim.label).collect();
            for (k, &a) in assigned.iter().enumerate() {
                for &b in &assigned[k + 1..] {
                    rivalries.entry((a, b)).and_modify(|rivalry| rivalry.both += 1);
                }
            }
        }
        let is_one = |r: &Rivalry| r.one >= LEAST_RIVALRY && f64::from(r.both) < MOST_BOTH * f64::from(r.one);
        // What does not change is not seen whole here.
        let stand = |label: u32| self.stands[label as usize];
        let was = |a: u32, b: u32| self.of.overruled.contains(&(stand(a), stand(b), self.pass));
        let is_old = |label: u32| self.of.last.contains_key(&stand(label));
        let of_pair = |((a, b), rivalry): ((u32, u32), Rivalry)| {
            let poses = self.drift_without(&[a, b], &rivalry.rays);
            let [of_a, of_b] = [a, b].map(|label| self.surprise(label, &rivalry.rays, &poses));
            if of_a <= of_b { (a, b) } else { (b, a) }
        };
        let decide = |((a, b), rivalry): ((u32, u32), Rivalry)| {
            if is_old(a) && is_old(b) {
                return [(a, b), (b, a)].into_iter().find(|&(a, b)| was(a, b));
            }
            is_one(&rivalry).then(|| of_pair(((a, b), rivalry)))
        };
        Ok(rivalries.into_iter().filter_map(decide).collect())
    }

    /// Pairs of labels that might have the same detection, and the images that show one of them there.
    fn rivalries(&self, fits: &[Vec<Fit>], progress: &Progress) -> Result<FxHashMap<(u32, u32), Rivalry>, Halt> {
        let limit = self.of.index.gate_sigmas().powi(2);
        let mut rivalries: FxHashMap<(u32, u32), Rivalry> = FxHashMap::default();
        for (i, (cases, fits)) in self.images.iter().zip(fits).enumerate() {
            progress.check()?;
            let is_shown = |label: u32| assigned(cases, fits).any(|claim| claim.label == label);
            let open = open(cases, fits, limit);
            for (k, a) in open.clone().enumerate() {
                for b in open.clone().skip(k + 1).filter(|b| b.ray == a.ray) {
                    let rivalry = rivalries.entry((a.label, b.label)).or_default();
                    if is_shown(a.label) != is_shown(b.label) {
                        rivalry.one += 1;
                        rivalry.rays.push((i, a.ray));
                    }
                }
            }
        }
        Ok(rivalries)
    }

    /// The drift in the images of some rays, as far as the votes for all but some labels tell.
    fn drift_without(&self, labels: &[u32], rays: &[(usize, u32)]) -> Vec<PoseError> {
        let segments = rays.iter().map(|(i, _)| self.segment_of[*i]);
        let first = segments.clone().min().unwrap_or(0).saturating_sub(SEGMENTS_AROUND);
        let end = (segments.max().unwrap_or(0) + SEGMENTS_AROUND + 1).min(self.starts_m.len());
        let mut of_segments = self.of_segments[first..end].to_vec();
        let from = self.segment_of.partition_point(|&segment| segment < first);
        let to = self.segment_of.partition_point(|&segment| segment < end);
        for (cases, segment) in self.images[from..to].iter().zip(&self.segment_of[from..to]) {
            let theirs = cases.iter().filter(|case| case.claim.is_vote && labels.contains(&case.claim.label));
            if theirs.clone().next().is_some() {
                of_segments[segment - first].take(&belief_of_votes(theirs));
            }
        }
        let smoothed = smooth(&self.starts_m[first..end], &of_segments);
        let of_ray = |&(i, ray): &(usize, u32)| {
            smoothed[self.segment_of[i] - first].pose_error(self.of.noise.shared(self.of.scene.view(ray)), Sigmas::NONE)
        };
        rays.iter().map(of_ray).collect()
    }

    /// Minus twice the logarithm of the likelihood that rays, the drift in whose images is about known, show a label, up to
    /// what is the same for all labels: together they may move the drift and the label once.
    fn surprise(&self, label: u32, rays: &[(usize, u32)], drift: &[PoseError]) -> f64 {
        let estimate = self.labels[label as usize].elsewhere(self.of.scene.view(rays[0].1));
        let look = |(&(_, ray), drift): (&(usize, u32), &PoseError)| {
            let look = Look::of(self.of.scene, self.of.noise, ray, 0, &estimate.point)?;
            Some(look.by_itself().with_drift(&drift.mean, drift.sigmas()))
        };
        let joint = || {
            let looks: Vec<Look> = rays.iter().zip(drift).map(look).collect::<Option<_>>()?;
            let normals = Drive::at_one(&looks)?.normals;
            let (information, gradient) = normals.of_one();
            let after = (information + estimate.covariance.try_inverse()?).cholesky()?;
            let widening = (after.determinant() * estimate.covariance.determinant()).ln();
            Some(normals.square - gradient.dot(&after.solve(&gradient)) + widening)
        };
        joint().unwrap_or(f64::INFINITY)
    }
}
