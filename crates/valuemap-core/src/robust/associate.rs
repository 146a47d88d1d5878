//! Which detection shows which label: all labels compete for all detections, image by image.
//!
//! The labels in an image are off by its pose error together, so that error is estimated first, from the votes along
//! the drive ([`poses`](super::poses)) and from the image's other detections; what is left of a residual tells two heads
//! on one pole apart where the pose error is as large as their distance. Where several labels and detections could
//! go together, the assignment with the least sum of costs wins (joint compatibility; the costs are those of maximum
//! likelihood).

use std::sync::Arc;

use nalgebra::{Matrix2, SMatrix, Vector3};
use pathfinding::prelude::{Matrix, kuhn_munkres_min};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::drift::{Drive, Look};
use super::estimate::Estimate;
use super::index::{Hit, RayIndex};
use super::label::Label;
use super::noise::Noise;
use super::poses::{Belief, Legs, PoseError, smooth};
use super::scene::Scene;
use crate::progress::{Halt, Progress};

/// Times that the assignment of an image is made anew, with the pose error from the last one.
const ROUNDS: usize = 3;
/// Costs are whole numbers of this part, so that sums do not depend on their order.
const COST_UNIT: f64 = 1e-6;
/// Squared residuals beyond this many squared sigmas count less in the drift, in proportion to their root.
const HUBER_CHI2: f64 = 4.0;

/// Images of a pass that show one of two labels, which may be either, before it is concluded that there is but one.
const LEAST_RIVALRY: u32 = 8;
/// For each of them, images that show both, at most: what clutter and double detections do.
const MOST_BOTH: f64 = 0.1;
/// Legs before and after those in question that say something about their drift.
const LEGS_AROUND: usize = 20;
/// Detections are looked for as far from a label as this many of its standard deviations, in steps of one.
const REACH_SIGMAS: i32 = 4;
/// Where a label's place is known this well, its uncertainty widens no gate, m.
const CERTAIN_M: f64 = 0.1;

/// A detection that a label may have.
#[derive(Debug, Clone, Copy)]
pub struct Claim {
    image: u32,
    /// The label's number.
    label: u32,
    ray: u32,
    /// Squared residual over its variance, pose error and all.
    chi2: f64,
    is_vote: bool,
}

/// A claim as seen from its label: residual with derivatives, and the covariance of all but the pose error, px².
struct Case<'a> {
    claim: &'a Claim,
    look: Look,
    own: Matrix2<f64>,
    /// Variance of the detection, each axis, px².
    detection_px2: f64,
}

/// Gives detections to labels, at most one an image and label.
///
/// It remembers what it decided last, and decides only those legs anew that a label claims which changed.
pub struct Association<'a> {
    scene: &'a Scene,
    noise: &'a Noise,
    index: RayIndex<'a>,
    /// Detections farther from a label are not its own, m.
    range_m: f64,
    legs: Legs,
    /// What the votes of each leg say of its drift.
    of_legs: Vec<Belief>,
    /// The claims of the labels, by what these were.
    last: FxHashMap<u64, Arc<[Claim]>>,
    overruled: FxHashSet<Overruled>,
}

/// Of two labels, as they were, the first overrules the second in a pass.
type Overruled = (u64, u64, u32);

/// What was decided on some legs.
struct Decided {
    decisions: Vec<Decision>,
    /// The legs from this one on, and what their votes say.
    of_legs: (usize, Vec<Belief>),
    overruled: Vec<Overruled>,
}

impl<'a> Association<'a> {
    /// Begin, with nothing decided.
    #[must_use]
    pub fn new(scene: &'a Scene, noise: &'a Noise, index: RayIndex<'a>, range_m: f64) -> Self {
        let legs = Legs::new(&scene.views);
        let of_legs = vec![Belief::nothing(); legs.pass.len()];
        let (last, overruled) = (FxHashMap::default(), FxHashSet::default());
        Self { scene, noise, index, range_m, legs, of_legs, last, overruled }
    }

    /// Give detections to labels: those that they had where nothing changed, else those that fit best.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] when `progress` says so.
    pub fn associate(&mut self, labels: Vec<Label>, progress: &Progress) -> Result<Vec<Label>, Halt> {
        let claims_of = |label: &Label| {
            progress.check()?;
            let identity = label.identity();
            let found = || claims_of(self.scene, &self.index, label, self.range_m).into();
            Ok((identity, self.last.get(&identity).map_or_else(found, Arc::clone)))
        };
        let claims: Vec<(u64, Arc<[Claim]>)> = labels.par_iter().map(claims_of).collect::<Result<_, Halt>>()?;
        let is_open = self.open_legs(&claims);
        let leg_of = |image: u32| self.legs.of_view[image as usize] as usize;
        let is_open_image = |image: u32| is_open[leg_of(image)];
        let of_label = |(number, (_, claims)): (usize, &(u64, Arc<[Claim]>))| {
            let open = claims.iter().filter(|claim| is_open_image(claim.image));
            open.map(|claim| Claim { label: number as u32, ..*claim }).collect::<Vec<_>>()
        };
        let mut open: Vec<Claim> = claims.par_iter().enumerate().flat_map_iter(of_label).collect();
        open.par_sort_unstable_by_key(|claim| (leg_of(claim.image), claim.image, claim.label, claim.ray));
        let is_one_run = |a: &Claim, b: &Claim| {
            let [a, b] = [a, b].map(|claim| leg_of(claim.image));
            self.legs.pass[a] == self.legs.pass[b] && b - a <= LEGS_AROUND
        };
        let identities: Vec<u64> = claims.iter().map(|(identity, _)| *identity).collect();
        let runs: Vec<&[Claim]> = open.chunk_by(is_one_run).collect();
        let decided: Vec<Decided> =
            runs.par_iter().map(|run| self.decide(&labels, &identities, run, progress)).collect::<Result<_, Halt>>()?;
        let mut voters: Vec<Vec<u32>> = Vec::with_capacity(labels.len());
        let mut undecided: Vec<Vec<u32>> = Vec::with_capacity(labels.len());
        for label in &labels {
            let stays = |ray: &&u32| !is_open_image(self.scene.rays.image[**ray as usize]);
            voters.push(label.voters.iter().filter(stays).copied().collect());
            undecided.push(label.undecided.iter().filter(|image| !is_open_image(**image)).copied().collect());
        }
        let current: FxHashSet<u64> = identities.iter().copied().collect();
        self.overruled.retain(|(a, b, _)| current.contains(a) && current.contains(b));
        for Decided { decisions, of_legs: (first, beliefs), overruled } in decided {
            self.of_legs[first..first + beliefs.len()].copy_from_slice(&beliefs);
            self.overruled.extend(overruled);
            for decision in decisions {
                match decision {
                    Decision::Vote { label, ray } => voters[label as usize].push(ray),
                    Decision::Undecided { label, image } => undecided[label as usize].push(image),
                }
            }
        }
        self.last = claims.into_iter().collect();
        let given = labels.into_iter().zip(voters).zip(undecided);
        Ok(given.map(|((label, voters), undecided)| given_to(self.scene, label, voters, undecided)).collect())
    }

    /// Legs that a label claims which was not there before, or is there no longer.
    fn open_legs(&self, claims: &[(u64, Arc<[Claim]>)]) -> Vec<bool> {
        let mut is_open = vec![false; self.legs.pass.len()];
        let current: FxHashSet<u64> = claims.iter().map(|(identity, _)| *identity).collect();
        let new = claims.iter().filter(|(identity, _)| !self.last.contains_key(identity)).map(|(_, claims)| claims);
        let gone = self.last.iter().filter(|(identity, _)| !current.contains(*identity)).map(|(_, claims)| claims);
        for claim in new.chain(gone).flat_map(|claims| claims.iter()) {
            is_open[self.legs.of_view[claim.image as usize] as usize] = true;
        }
        is_open
    }

    /// Decide the claims of some legs of one pass, ordered by leg and image.
    fn decide(
        &self,
        labels: &[Label],
        identities: &[u64],
        claims: &[Claim],
        progress: &Progress,
    ) -> Result<Decided, Halt> {
        let (scene, noise, limit) = (self.scene, self.noise, self.index.gate_sigmas().powi(2));
        let cases: Vec<Case<'_>> =
            claims.iter().filter_map(|claim| Case::of(scene, noise, &labels[claim.label as usize], claim)).collect();
        let run = Run::new(self, labels, identities, &cases);
        let smoothed = smooth(&run.starts_m, &run.of_legs);
        let judge = |(i, cases): (usize, &&[Case<'_>])| {
            let view = &scene.views[cases[0].claim.image as usize];
            // Its own votes are what is in question.
            let belief = smoothed[run.leg_of[i]].without(&run.votes[i]);
            progress.check()?;
            Ok(grant(cases, limit, &belief.pose_error(noise.shared(view), noise.of_image(view))))
        };
        let mut fits: Vec<Vec<Fit>> = run.images.iter().enumerate().map(judge).collect::<Result<_, Halt>>()?;
        let overruled = run.overruled(&fits, progress)?;
        let mut decisions = Vec::new();
        for (cases, fits) in run.images.iter().zip(&mut fits) {
            overrule(cases, fits, &overruled, limit);
            report(cases, fits, labels, limit, &mut decisions);
        }
        let (first, end) = run.own_legs;
        let of_legs = run.of_legs[first - run.first_leg..end - run.first_leg].to_vec();
        let named = |(a, b): (u32, u32)| (identities[a as usize], identities[b as usize], run.pass);
        let overruled = overruled.into_iter().map(named).collect();
        Ok(Decided { decisions, of_legs: (first, of_legs), overruled })
    }
}

/// A label with the votes that it was given, in any order, and the images that are undecided.
fn given_to(scene: &Scene, label: Label, mut voters: Vec<u32>, mut undecided: Vec<u32>) -> Label {
    scene.sort_by_pass(&mut voters);
    undecided.sort_unstable();
    let mut label = Label { undecided, ..label };
    let fitting = || voters.iter().copied().filter(|ray| !label.refused.contains(ray));
    if !fitting().eq(label.voters.iter().copied()) {
        label.refused.clear();
        label.voters = voters;
    }
    label
}

fn claims_of(scene: &Scene, index: &RayIndex<'_>, label: &Label, range_m: f64) -> Vec<Claim> {
    let mut voters = label.voters.clone();
    voters.sort_unstable();
    let mut hits: Vec<Hit> =
        places_of(&label.estimate).iter().flat_map(|place| index.all_hits(place, label.class, range_m)).collect();
    hits.sort_by(|a, b| a.ray.cmp(&b.ray).then(a.chi2.total_cmp(&b.chi2)));
    hits.dedup_by_key(|hit| hit.ray);
    let of_hit = |hit: Hit| Claim {
        image: hit.image,
        label: u32::MAX,
        ray: hit.ray,
        chi2: hit.chi2,
        is_vote: voters.binary_search(&hit.ray).is_ok(),
    };
    hits.into_iter().filter(|hit| label.faces(scene, hit.ray)).map(of_hit).collect()
}

/// Where a label may be: along the direction that it is least known in.
fn places_of(estimate: &Estimate) -> Vec<Vector3<f64>> {
    let axes = estimate.covariance.symmetric_eigen();
    let longest = axes.eigenvalues.imax();
    let sigma = axes.eigenvalues[longest].max(0.0).sqrt();
    if sigma < CERTAIN_M {
        return vec![estimate.point];
    }
    let axis = axes.eigenvectors.column(longest) * sigma;
    (-REACH_SIGMAS..=REACH_SIGMAS).map(|step| estimate.point + axis * f64::from(step)).collect()
}

enum Decision {
    Vote { label: u32, ray: u32 },
    Undecided { label: u32, image: u32 },
}

/// What is claimed on some legs of one pass: the cases, image by image, and what the votes say about the drift.
struct Run<'a> {
    of: &'a Association<'a>,
    labels: &'a [Label],
    identities: &'a [u64],
    pass: u32,
    images: Vec<&'a [Case<'a>]>,
    /// What the votes of each image say.
    votes: Vec<Belief>,
    /// The leg of each image, counted from the first leg around.
    leg_of: Vec<usize>,
    first_leg: usize,
    /// The first and the end of the legs with images, counted from the first of all.
    own_legs: (usize, usize),
    /// Where the legs around begin, m driven, and what their votes say.
    starts_m: Vec<f64>,
    of_legs: Vec<Belief>,
}

impl<'a> Case<'a> {
    fn of(scene: &Scene, noise: &Noise, label: &Label, claim: &'a Claim) -> Option<Self> {
        let estimate = label.elsewhere(scene.view(claim.ray));
        let look = Look::of(scene, noise, claim.ray, claim.label as usize, &estimate.point)?;
        let by_point = SMatrix::<f64, 2, 3>::from_rows(&[look.by_point[0].transpose(), look.by_point[1].transpose()]);
        let of_label = by_point * estimate.covariance * by_point.transpose();
        let detection_px2 = noise.detection_px2(scene, claim.ray);
        Some(Self { claim, look, own: Matrix2::identity() * detection_px2 + of_label, detection_px2 })
    }

    /// How well it fits where the pose error is about as said.
    fn cost(&self, pose: &PoseError) -> f64 {
        let (residual, covariance) = pose.expected(&self.look, &self.own);
        let chi2 = covariance.try_inverse().map_or(f64::INFINITY, |inverse| residual.dot(&(inverse * residual)));
        // Narrow likelihoods are high: a label of which little is known must not win because it forbids nothing.
        let widening = (covariance - self.own + Matrix2::identity() * self.detection_px2).determinant();
        chi2 + (covariance.determinant() / widening).ln()
    }
}

/// What the votes of one image say about the drift of its pass.
fn belief_of_votes<'c>(cases: impl Iterator<Item = &'c Case<'c>>) -> Belief {
    cases.filter(|case| case.claim.is_vote).fold(Belief::nothing(), |sum, case| {
        let of_label_px2 = 0.5 * case.own.trace() - case.detection_px2;
        let robust = (HUBER_CHI2 / case.claim.chi2).sqrt().min(1.0);
        sum.and(&Belief::of_vote(&case.look, (case.look.variance + of_label_px2) / robust))
    })
}

/// What became of a claim.
#[derive(Debug, Clone, Copy)]
struct Fit {
    /// Squared residual, and how much wider its distribution is than that of a label known exactly.
    cost: f64,
    granted: bool,
}

/// Judge the claims of one image, whose pose error is about known.
fn grant(cases: &[Case<'_>], limit: f64, pose: &PoseError) -> Vec<Fit> {
    let mut costs: Vec<f64> = cases.iter().map(|case| case.cost(pose)).collect();
    let mut granted = assign(cases, &costs, limit);
    for _ in 1..ROUNDS {
        for (i, case) in cases.iter().enumerate().filter(|(i, _)| (0..cases.len()).any(|j| shares(cases, *i, j))) {
            let others = granted.iter().map(|&j| &cases[j]);
            let independent = others.filter(|o| o.claim.label != case.claim.label && o.claim.ray != case.claim.ray);
            let known = independent.fold(*pose, |pose, other| pose.after(&other.look, &other.own));
            costs[i] = case.cost(&known);
        }
        let again = assign(cases, &costs, limit);
        if again == granted {
            break;
        }
        granted = again;
    }
    (0..).zip(costs).map(|(i, cost)| Fit { cost, granted: granted.binary_search(&i).is_ok() }).collect()
}

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

impl<'a> Run<'a> {
    fn new(of: &'a Association<'a>, labels: &'a [Label], identities: &'a [u64], cases: &'a [Case<'a>]) -> Self {
        let legs = &of.legs;
        let images: Vec<&[Case<'_>]> = cases.chunk_by(|a, b| a.claim.image == b.claim.image).collect();
        let leg_of = |cases: &&[Case<'_>]| legs.of_view[cases[0].claim.image as usize] as usize;
        let own_legs = (images.first().map_or(0, leg_of), images.last().map_or(0, |image| leg_of(image) + 1));
        let pass = legs.pass[own_legs.0];
        let is_of_pass = |leg: &usize| legs.pass[*leg] == pass;
        let before = (0..own_legs.0).rev().take(LEGS_AROUND).take_while(is_of_pass).count();
        let after = (own_legs.1..legs.pass.len()).take(LEGS_AROUND).take_while(is_of_pass).count();
        let around = own_legs.0 - before..own_legs.1 + after;
        let leg_of: Vec<usize> = images.iter().map(|image| leg_of(image) - around.start).collect();
        let votes: Vec<Belief> = images.iter().map(|cases| belief_of_votes(cases.iter())).collect();
        let mut of_legs = of.of_legs[around.clone()].to_vec();
        for &leg in &leg_of {
            of_legs[leg] = Belief::nothing();
        }
        for (vote, &leg) in votes.iter().zip(&leg_of) {
            of_legs[leg] = of_legs[leg].and(vote);
        }
        let starts_m = legs.start_m[around.clone()].to_vec();
        let first_leg = around.start;
        Self { of, labels, identities, pass, images, votes, leg_of, first_leg, own_legs, starts_m, of_legs }
    }

    /// Pairs of labels (the better one, the other) of which a pass shows only one, where it might be either: there is one
    /// object, and the other label is not to be seen from there.
    fn overruled(&self, fits: &[Vec<Fit>], progress: &Progress) -> Result<FxHashSet<(u32, u32)>, Halt> {
        let limit = self.of.index.gate_sigmas().powi(2);
        let mut rivalries: FxHashMap<(u32, u32), Rivalry> = FxHashMap::default();
        for (i, (cases, fits)) in self.images.iter().zip(fits).enumerate() {
            progress.check()?;
            let granted: Vec<u32> =
                cases.iter().zip(fits).filter(|(_, fit)| fit.granted).map(|(case, _)| case.claim.label).collect();
            let shown: FxHashSet<u32> = granted.iter().copied().collect();
            for (k, &a) in granted.iter().enumerate() {
                for &b in &granted[k + 1..] {
                    rivalries.entry((a, b)).or_default().both += 1;
                }
            }
            let mut open: Vec<&Claim> =
                cases.iter().zip(fits).filter(|(_, fit)| fit.cost < limit).map(|(case, _)| case.claim).collect();
            open.sort_unstable_by_key(|claim| (claim.ray, claim.label));
            for of_ray in open.chunk_by(|a, b| a.ray == b.ray) {
                for (k, a) in of_ray.iter().enumerate() {
                    for b in &of_ray[k + 1..] {
                        if shown.contains(&a.label) != shown.contains(&b.label) {
                            let rivalry = rivalries.entry((a.label, b.label)).or_default();
                            rivalry.one += 1;
                            rivalry.rays.push((i, a.ray));
                        }
                    }
                }
            }
        }
        let is_one = |r: &Rivalry| r.one >= LEAST_RIVALRY && f64::from(r.both) < MOST_BOTH * f64::from(r.one);
        // What does not change is not seen whole here.
        let identity = |label: u32| self.identities[label as usize];
        let was = |a: u32, b: u32| self.of.overruled.contains(&(identity(a), identity(b), self.pass));
        let is_old = |label: u32| self.of.last.contains_key(&identity(label));
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

    /// The drift in the images of some rays, as far as the votes for all but some labels tell.
    fn drift_without(&self, labels: &[u32], rays: &[(usize, u32)]) -> Vec<PoseError> {
        let legs = rays.iter().map(|(i, _)| self.leg_of[*i]);
        let first = legs.clone().min().unwrap_or(0).saturating_sub(LEGS_AROUND);
        let end = (legs.max().unwrap_or(0) + LEGS_AROUND + 1).min(self.starts_m.len());
        let mut of_legs = self.of_legs[first..end].to_vec();
        let from = self.leg_of.partition_point(|&leg| leg < first);
        let to = self.leg_of.partition_point(|&leg| leg < end);
        for (cases, leg) in self.images[from..to].iter().zip(&self.leg_of[from..to]) {
            let theirs = cases.iter().filter(|case| labels.contains(&case.claim.label));
            of_legs[leg - first] = of_legs[leg - first].without(&belief_of_votes(theirs));
        }
        let smoothed = smooth(&self.starts_m[first..end], &of_legs);
        let of_ray = |&(i, ray): &(usize, u32)| {
            smoothed[self.leg_of[i] - first].pose_error(self.of.noise.shared(self.of.scene.view(ray)), (0.0, 0.0))
        };
        rays.iter().map(of_ray).collect()
    }

    /// Minus twice the logarithm of the likelihood that rays, the drift in whose images is about known, show a label, up to
    /// what is the same for all labels: together they may move the drift and the label once.
    fn surprise(&self, label: u32, rays: &[(usize, u32)], drift: &[PoseError]) -> f64 {
        let estimate = self.labels[label as usize].elsewhere(self.of.scene.view(rays[0].1));
        let look = |(&(_, ray), drift): (&(usize, u32), &PoseError)| {
            let look = Look::of(self.of.scene, self.of.noise, ray, 0, &estimate.point)?;
            Some(look.by_itself().with_drift(&drift.mean, &drift.covariance.diagonal().map(f64::sqrt)))
        };
        let joint = || {
            let looks: Vec<Look> = rays.iter().zip(drift).map(look).collect::<Option<_>>()?;
            let normals = Drive::along(&looks, &vec![1.0; looks.len()], 1)?.normals;
            let (information, gradient) = normals.of_one();
            let after = (information + estimate.covariance.try_inverse()?).cholesky()?;
            let widening = (after.determinant() * estimate.covariance.determinant()).ln();
            Some(normals.square - gradient.dot(&after.solve(&gradient)) + widening)
        };
        joint().unwrap_or(f64::INFINITY)
    }
}

/// Take the detections that a better label claims as well from labels that are overruled.
fn overrule(cases: &[Case<'_>], fits: &mut [Fit], overruled: &FxHashSet<(u32, u32)>, limit: f64) {
    let is_overruled = |j: usize, fits: &[Fit]| {
        let claim = cases[j].claim;
        let mut rivals = (0..cases.len()).filter(|&i| fits[i].cost < limit && cases[i].claim.ray == claim.ray);
        rivals.any(|i| overruled.contains(&(cases[i].claim.label, claim.label)))
    };
    let out: Vec<usize> = (0..cases.len()).filter(|&j| fits[j].cost < limit && is_overruled(j, fits)).collect();
    if out.is_empty() {
        return;
    }
    let mut costs: Vec<f64> = fits.iter().map(|fit| fit.cost).collect();
    for &j in &out {
        costs[j] = f64::INFINITY;
    }
    let granted = assign(cases, &costs, limit);
    for (i, fit) in fits.iter_mut().enumerate() {
        fit.granted = granted.binary_search(&i).is_ok();
    }
}

/// Say which claims of one image are granted, and which labels it says nothing about.
fn report(cases: &[Case<'_>], fits: &[Fit], labels: &[Label], limit: f64, decisions: &mut Vec<Decision>) {
    let strength = |label: u32| (labels[label as usize].voters.len(), std::cmp::Reverse(label));
    let granted = || cases.iter().zip(fits).filter(|(_, fit)| fit.granted).map(|(case, _)| case.claim);
    let is_idle = |label: u32| !granted().any(|claim| claim.label == label);
    let open = cases.iter().zip(fits).filter(|(_, fit)| fit.cost < limit).map(|(case, _)| case.claim);
    let idle: Vec<&Claim> = open.filter(|claim| is_idle(claim.label)).collect();
    for &Claim { image, label, ray, .. } in granted() {
        decisions.push(Decision::Vote { label, ray });
        if idle.iter().any(|other| other.ray == ray && strength(other.label) > strength(label)) {
            decisions.push(Decision::Undecided { label, image });
        }
    }
    for loser in idle.chunk_by(|a, b| a.label == b.label) {
        decisions.push(Decision::Undecided { label: loser[0].label, image: loser[0].image });
    }
}

/// The claims to grant, ascending: the assignment with the least sum of costs, where a detection without a label costs as
/// much as one at the gate.
fn assign(cases: &[Case<'_>], costs: &[f64], limit: f64) -> Vec<usize> {
    let open: Vec<usize> = (0..cases.len()).filter(|&i| costs[i] < limit).collect();
    if !open.iter().any(|&i| open.iter().any(|&j| shares(cases, i, j))) {
        return open;
    }
    let mut rays: Vec<u32> = open.iter().map(|&i| cases[i].claim.ray).collect();
    rays.sort_unstable();
    rays.dedup();
    let mut labels: Vec<u32> = open.iter().map(|&i| cases[i].claim.label).collect();
    labels.sort_unstable();
    labels.dedup();
    let none = (limit / COST_UNIT) as i64;
    // One more column for each detection: it shows no label.
    let mut table = Matrix::new(rays.len(), labels.len() + rays.len(), 2 * none);
    for row in 0..rays.len() {
        for column in labels.len()..labels.len() + rays.len() {
            table[(row, column)] = none;
        }
    }
    for &i in &open {
        let at = (rays.binary_search(&cases[i].claim.ray), labels.binary_search(&cases[i].claim.label));
        if let (Ok(row), Ok(column)) = at {
            table[(row, column)] = (costs[i] / COST_UNIT) as i64;
        }
    }
    let (_, columns) = kuhn_munkres_min(&table);
    let is_granted = |i: &usize| {
        let at = (rays.binary_search(&cases[*i].claim.ray), labels.binary_search(&cases[*i].claim.label));
        matches!(at, (Ok(row), Ok(column)) if columns[row] == column)
    };
    open.into_iter().filter(is_granted).collect()
}

/// Whether two claims are for the same label or the same detection.
fn shares(cases: &[Case<'_>], i: usize, j: usize) -> bool {
    i != j && (cases[i].claim.label == cases[j].claim.label || cases[i].claim.ray == cases[j].claim.ray)
}
