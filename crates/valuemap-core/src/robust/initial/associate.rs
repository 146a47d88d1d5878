//! Association: all labels compete for all detections, image by image.
//!
//! The pose error of each image is estimated first, from the votes along the drive ([`poses`](crate::robust::noise::poses)). Then each
//! image is decided for itself ([`assignment`](mod@super::assignment)), and rivals for a whole pass ([`rivals`](super::rivals)).

use std::sync::Arc;

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::assignment::{Case, Claim, Fit, assigned, belief_of_votes, decide, overrule};
use super::label::Label;
use crate::progress::{Halt, Progress};
use crate::robust::energy::estimate::Estimate;
use crate::robust::energy::extent::REACH_SIGMAS;
use crate::robust::noise::Noise;
use crate::robust::noise::index::{Hit, RayIndex};
use crate::robust::noise::poses::{Belief, SEGMENTS_AROUND, Segments, smooth};
use crate::robust::scene::Scene;
use crate::robust::scene::sample::fingerprint;

/// Where a label's place is known this well, its uncertainty widens no gate, m. With the width of a gate instead, maps of real data are worse.
const CERTAIN_M: f64 = 0.1;

/// Gives detections to labels, at most one an image and label.
///
/// It remembers what it decided last, and decides only those segments anew that a label claims which changed.
pub struct Association<'a> {
    pub(super) scene: &'a Scene,
    pub(super) noise: &'a Noise,
    pub(super) index: RayIndex<'a>,
    /// Detections farther from a label are not its own, m.
    range_m: f64,
    segments: Segments,
    /// What the votes of each segment say of its drift.
    of_segments: Vec<Belief>,
    /// The claims of the labels, by where these stood.
    pub(super) last: FxHashMap<u64, Arc<Claimed>>,
    pub(super) overruled: FxHashSet<Overruled>,
}

/// What a label claims, with the votes that it had.
pub(super) struct Claimed {
    /// Fingerprint of its voters.
    voters: u64,
    claims: Vec<Claim>,
}

/// Of two labels, where they stood, the first overrules the second in a pass.
type Overruled = (u64, u64, u32);

/// What was decided on some segments.
struct Decided {
    /// Labels with the rays that vote for them.
    votes: Vec<(u32, u32)>,
    /// The segments from this one on, and what their votes say.
    of_segments: (usize, Vec<Belief>),
    overruled: Vec<Overruled>,
}

impl<'a> Association<'a> {
    /// Begin, with nothing decided.
    #[must_use]
    pub fn new(scene: &'a Scene, noise: &'a Noise, index: RayIndex<'a>, range_m: f64) -> Self {
        let segments = Segments::new(&scene.views);
        let of_segments = vec![Belief::nothing(); segments.pass.len()];
        let (last, overruled) = (FxHashMap::default(), FxHashSet::default());
        Self { scene, noise, index, range_m, segments, of_segments, last, overruled }
    }

    /// Give detections to labels: those that they had where nothing changed, else those that fit best.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] when `progress` says so.
    pub fn associate(&mut self, labels: Vec<Label>, progress: &Progress) -> Result<Vec<Label>, Halt> {
        let claimed_by = |label: &Label| {
            progress.check()?;
            let stand = label.stand();
            Ok((stand, self.claimed_by(label, stand)))
        };
        let claims: Vec<(u64, Arc<Claimed>)> = labels.par_iter().map(claimed_by).collect::<Result<_, Halt>>()?;
        let stands: Vec<u64> = claims.iter().map(|(stand, _)| *stand).collect();
        let current: FxHashSet<u64> = stands.iter().copied().collect();
        let is_open = self.open_segments(&claims, &current);
        let mut open = by_segment(&claims, &is_open);
        let is_one_run = |a: &Claim, b: &Claim| {
            let [a, b] = [a.segment as usize, b.segment as usize];
            self.segments.pass[a] == self.segments.pass[b] && b - a <= SEGMENTS_AROUND
        };
        let runs: Vec<&mut [Claim]> = open.chunk_by_mut(is_one_run).collect();
        let decide = |run: &mut [Claim]| {
            run.sort_by_key(|claim| (claim.segment, claim.image));
            self.decide(&labels, &stands, run, progress)
        };
        let decided: Vec<Decided> = runs.into_par_iter().map(decide).collect::<Result<_, Halt>>()?;
        let is_open_image = |image: u32| is_open[self.segments.of_view[image as usize] as usize];
        let mut voters: Vec<Vec<u32>> = Vec::with_capacity(labels.len());
        for label in &labels {
            let stays = |ray: &&u32| !is_open_image(self.scene.image_of(**ray));
            voters.push(label.voters.iter().filter(stays).copied().collect());
        }
        self.overruled.retain(|(a, b, _)| current.contains(a) && current.contains(b));
        for Decided { votes, of_segments: (first, beliefs), overruled } in decided {
            self.of_segments[first..first + beliefs.len()].copy_from_slice(&beliefs);
            self.overruled.extend(overruled);
            for (label, ray) in votes {
                voters[label as usize].push(ray);
            }
        }
        self.last = claims.into_iter().collect();
        Ok(labels.into_par_iter().zip(voters).map(|(label, voters)| given_to(self.scene, label, voters)).collect())
    }

    /// The claims of a label: those that it had if it is where it was.
    fn claimed_by(&self, label: &Label, stand: u64) -> Arc<Claimed> {
        let voters = fingerprint(&label.voters);
        match self.last.get(&stand) {
            Some(last) if last.voters == voters => Arc::clone(last),
            Some(last) => Arc::new(Claimed { voters, claims: with_votes_of(label, last.claims.clone()) }),
            None => Arc::new(Claimed { voters, claims: with_votes_of(label, self.claims_of(label)) }),
        }
    }

    /// All claims of a label, by ray; none is a vote yet.
    fn claims_of(&self, label: &Label) -> Vec<Claim> {
        let mut hits = self.index.hits_of_any(&places_of(&label.estimate), &|class| class == label.class, self.range_m);
        hits.retain(|hit| label.faces(self.scene, hit.ray));
        hits.sort_by_key(|hit| hit.ray);
        let of_hit = |Hit { ray, image, chi2 }: Hit| {
            let segment = self.segments.of_view[image as usize];
            Claim { segment, image, label: u32::MAX, ray, chi2, is_vote: false }
        };
        hits.into_iter().map(of_hit).collect()
    }

    /// Segments that a label claims which was not there before, or is there no longer, or where its votes changed.
    fn open_segments(&self, claims: &[(u64, Arc<Claimed>)], current: &FxHashSet<u64>) -> Vec<bool> {
        let mut is_open = vec![false; self.segments.pass.len()];
        let mut open = |claim: &Claim| is_open[claim.segment as usize] = true;
        for (stand, now) in claims {
            match self.last.get(stand) {
                None => now.claims.iter().for_each(&mut open),
                Some(last) if last.voters != now.voters => {
                    let both = now.claims.iter().zip(&last.claims);
                    both.filter(|(now, last)| now.is_vote != last.is_vote).for_each(|(now, _)| open(now));
                }
                Some(_) => {}
            }
        }
        let gone = self.last.iter().filter(|(stand, _)| !current.contains(*stand));
        gone.flat_map(|(_, last)| &last.claims).for_each(&mut open);
        is_open
    }

    /// Decide the claims of some segments of one pass, ordered by segment and image.
    fn decide(&self, labels: &[Label], stands: &[u64], claims: &[Claim], progress: &Progress) -> Result<Decided, Halt> {
        let (scene, noise, limit) = (self.scene, self.noise, self.index.gate_sigmas().powi(2));
        // Not collected: hardly any is left out, and an iterator that may does not say how many there will be.
        let mut cases: Vec<Case<'_>> = Vec::with_capacity(claims.len());
        cases.extend(claims.iter().filter_map(|claim| Case::of(scene, noise, &labels[claim.label as usize], claim)));
        let run = Run::new(self, labels, stands, &cases);
        let smoothed = smooth(&run.starts_m, &run.of_segments);
        let judge = |(i, cases): (usize, &&[Case<'_>])| {
            let view = &scene.views[cases[0].claim.image as usize];
            // Its own votes are what is in question.
            let belief = smoothed[run.segment_of[i]].without(&run.votes[i]);
            progress.check()?;
            Ok(decide(cases, limit, &belief.pose_error(noise.shared(view), noise.of_image(view))))
        };
        let mut fits: Vec<Vec<Fit>> = run.images.iter().enumerate().map(judge).collect::<Result<_, Halt>>()?;
        let overruled = run.overruled(&fits, progress)?;
        let mut votes = Vec::new();
        for (cases, fits) in run.images.iter().zip(&mut fits) {
            overrule(cases, fits, &overruled, limit);
            votes.extend(assigned(cases, fits).map(|claim| (claim.label, claim.ray)));
        }
        let (first, end) = run.own_segments;
        let of_segments = run.of_segments[first - run.first_segment..end - run.first_segment].to_vec();
        let named = |(a, b): (u32, u32)| (stands[a as usize], stands[b as usize], run.pass);
        let overruled = overruled.into_iter().map(named).collect();
        Ok(Decided { votes, of_segments: (first, of_segments), overruled })
    }
}

/// A label with the votes that it was given, in any order.
fn given_to(scene: &Scene, mut label: Label, mut voters: Vec<u32>) -> Label {
    voters.sort_unstable();
    let fitting = || voters.iter().copied().filter(|ray| !label.refused.contains(ray));
    if !fitting().eq(label.voters.iter().copied()) {
        let key = |ray: u32| (scene.view(ray).pass, ray);
        let last = |&ray: &u32| label.voters.binary_search_by_key(&key(ray), |&old| key(old)).map(|i| label.weights[i]);
        label.weights = voters.iter().map(|ray| last(ray).unwrap_or(1.0)).collect();
        label.refused.clear();
        label.voters = voters;
    }
    label
}

/// The claims of all labels on some segments: segment by segment, each label after label and ray after ray.
fn by_segment(claims: &[(u64, Arc<Claimed>)], is_open: &[bool]) -> Vec<Claim> {
    let open = || {
        let all = (0..)
            .zip(claims)
            .flat_map(|(label, (_, of_label))| of_label.claims.iter().map(move |claim| Claim { label, ..*claim }));
        all.filter(|claim| is_open[claim.segment as usize])
    };
    let mut next = vec![0; is_open.len() + 1];
    for claim in open() {
        next[claim.segment as usize + 1] += 1;
    }
    for segment in 0..is_open.len() {
        next[segment + 1] += next[segment];
    }
    let mut sorted = vec![Claim::default(); next[is_open.len()]];
    for claim in open() {
        let place = &mut next[claim.segment as usize];
        sorted[*place] = claim;
        *place += 1;
    }
    sorted
}

/// Claims (any order) with those marked that are votes.
fn with_votes_of(label: &Label, mut claims: Vec<Claim>) -> Vec<Claim> {
    let mut voters = label.voters.clone();
    voters.sort_unstable();
    for claim in &mut claims {
        claim.is_vote = voters.binary_search(&claim.ray).is_ok();
    }
    claims
}

/// Where a label may be: along the direction that it is least known in, in steps of a standard deviation.
fn places_of(estimate: &Estimate) -> Vec<Vector3<f64>> {
    let axes = estimate.covariance.symmetric_eigen();
    let longest = axes.eigenvalues.imax();
    let sigma = axes.eigenvalues[longest].max(0.0).sqrt();
    if sigma < CERTAIN_M {
        return vec![estimate.point];
    }
    let axis = axes.eigenvectors.column(longest) * sigma;
    let steps = REACH_SIGMAS as i32;
    (-steps..=steps).map(|step| estimate.point + axis * f64::from(step)).collect()
}

/// What is claimed on some segments of one pass: the cases, image by image, and what the votes say about the drift.
pub(super) struct Run<'a> {
    pub(super) of: &'a Association<'a>,
    pub(super) labels: &'a [Label],
    pub(super) stands: &'a [u64],
    pub(super) pass: u32,
    pub(super) images: Vec<&'a [Case<'a>]>,
    /// What the votes of each image say.
    pub(super) votes: Vec<Belief>,
    /// The segment of each image, counted from the first segment around.
    pub(super) segment_of: Vec<usize>,
    pub(super) first_segment: usize,
    /// The first and the end of the segments with images, counted from the first of all.
    pub(super) own_segments: (usize, usize),
    /// Where the segments around begin, m driven, and what their votes say.
    pub(super) starts_m: Vec<f64>,
    pub(super) of_segments: Vec<Belief>,
}

impl<'a> Run<'a> {
    fn new(of: &'a Association<'a>, labels: &'a [Label], stands: &'a [u64], cases: &'a [Case<'a>]) -> Self {
        let segments = &of.segments;
        let images: Vec<&[Case<'_>]> = cases.chunk_by(|a, b| a.claim.image == b.claim.image).collect();
        let segment_of = |cases: &&[Case<'_>]| segments.of_view[cases[0].claim.image as usize] as usize;
        let own_segments =
            (images.first().map_or(0, segment_of), images.last().map_or(0, |image| segment_of(image) + 1));
        let pass = segments.pass[own_segments.0];
        let is_of_pass = |segment: &usize| segments.pass[*segment] == pass;
        let before = (0..own_segments.0).rev().take(SEGMENTS_AROUND).take_while(is_of_pass).count();
        let after = (own_segments.1..segments.pass.len()).take(SEGMENTS_AROUND).take_while(is_of_pass).count();
        let around = own_segments.0 - before..own_segments.1 + after;
        let segment_of: Vec<usize> = images.iter().map(|image| segment_of(image) - around.start).collect();
        let votes: Vec<Belief> = images.iter().map(|cases| belief_of_votes(cases.iter())).collect();
        let mut of_segments = of.of_segments[around.clone()].to_vec();
        for &segment in &segment_of {
            of_segments[segment] = Belief::nothing();
        }
        for (vote, &segment) in votes.iter().zip(&segment_of) {
            of_segments[segment].add(vote);
        }
        let starts_m = segments.start_m[around.clone()].to_vec();
        let first_segment = around.start;
        Self { of, labels, stands, pass, images, votes, segment_of, first_segment, own_segments, starts_m, of_segments }
    }
}
