//! Which detection shows which label: all labels compete for all detections, image by image.
//!
//! The labels in an image are off by its pose error together, so that error is estimated first, from the votes along
//! the drive ([`poses`](super::poses)) and from the image's other detections; what is left of a residual tells two heads
//! on one pole apart where the pose error is as large as their distance. Where several labels and detections could
//! go together, the assignment with the least sum of costs wins (joint compatibility; the costs are those of maximum
//! likelihood).

use nalgebra::{Matrix2, SMatrix, Vector3};
use pathfinding::prelude::{Matrix, kuhn_munkres_min};
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

use super::drift::Look;
use super::estimate::{Estimate, by_pass, is_one_visit, pass_terms};
use super::index::{Hit, RayIndex};
use super::label::Label;
use super::noise::Noise;
use super::poses::{Belief, PoseError, legs, smooth};
use super::scene::{Scene, View};
use crate::progress::{Halt, Progress};

/// Times that the assignment of an image is made anew, with the pose error from the last one.
const ROUNDS: usize = 3;
/// Costs are whole numbers of this part, so that sums do not depend on their order.
const COST_UNIT: f64 = 1e-6;
/// Squared residuals beyond this many squared sigmas count less in the drift, in proportion to their root.
const HUBER_CHI2: f64 = 4.0;

/// How much of what the votes of a pass say about a label is left out when their pass is judged.
const OTHERS_SHARE: f64 = 0.95;
/// Farther than this the linear step to where the other passes put a label is not trusted, m.
const LONGEST_STEP_M: f64 = 3.0;

/// Images of a pass that show one of two labels, which may be either, before it is concluded that there is but one.
const LEAST_RIVALRY: u32 = 8;
/// For each of them, images that show both, at most: what clutter and double detections do.
const MOST_BOTH: f64 = 0.1;
/// Detections are looked for as far from a label as this many of its standard deviations, in steps of one.
const REACH_SIGMAS: i32 = 4;
/// Where a label's place is known this well, its uncertainty widens no gate, m.
const CERTAIN_M: f64 = 0.1;

/// What an association says of one label.
#[derive(Debug, Clone, Default)]
pub struct Verdict {
    /// Its rays.
    pub voters: Vec<u32>,
    /// Images that say nothing for or against it, see [`Label::undecided`].
    pub undecided: Vec<u32>,
}

/// A detection that a label may have.
struct Claim {
    pass: u32,
    image: u32,
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

/// Give detections to labels, at most one an image and label.
///
/// # Errors
/// [`Halt::Cancelled`] when `progress` says so.
pub fn associate(
    scene: &Scene,
    noise: &Noise,
    index: &RayIndex<'_>,
    labels: &[Label],
    range_m: f64,
    progress: &Progress,
) -> Result<Vec<Verdict>, Halt> {
    let of_labels: Vec<Vec<Claim>> = labels
        .par_iter()
        .enumerate()
        .map(|(number, label)| {
            progress.check()?;
            Ok(claims_of(scene, index, number as u32, label, range_m))
        })
        .collect::<Result<_, Halt>>()?;
    let mut claims: Vec<Claim> = of_labels.into_iter().flatten().collect();
    claims.par_sort_unstable_by_key(|claim| (claim.pass, claim.image, claim.label, claim.ray));
    let view = |claim: &Claim| &scene.views[claim.image as usize];
    let passes: Vec<&[Claim]> = claims.chunk_by(|a, b| is_one_visit(view(a), view(b))).collect();
    let limit = index.gate_sigmas().powi(2);
    let decide_pass = |pass: &&[Claim]| decide(scene, noise, labels, limit, pass, progress);
    let decided: Vec<Vec<Decision>> = passes.par_iter().map(decide_pass).collect::<Result<_, Halt>>()?;
    let mut verdicts = vec![Verdict::default(); labels.len()];
    for decision in decided.into_iter().flatten() {
        match decision {
            Decision::Vote { label, ray } => verdicts[label as usize].voters.push(ray),
            Decision::Undecided { label, image } => verdicts[label as usize].undecided.push(image),
        }
    }
    for verdict in &mut verdicts {
        verdict.undecided.sort_unstable();
    }
    Ok(verdicts)
}

fn claims_of(scene: &Scene, index: &RayIndex<'_>, number: u32, label: &Label, range_m: f64) -> Vec<Claim> {
    let mut voters = label.voters.clone();
    voters.sort_unstable();
    let mut hits: Vec<Hit> =
        places_of(&label.estimate).iter().flat_map(|place| index.all_hits(place, label.class, range_m)).collect();
    hits.sort_by(|a, b| a.ray.cmp(&b.ray).then(a.chi2.total_cmp(&b.chi2)));
    hits.dedup_by_key(|hit| hit.ray);
    hits.into_iter()
        .filter(|hit| label.faces(scene, hit.ray))
        .map(|hit| Claim {
            pass: scene.views[hit.image as usize].pass,
            image: hit.image,
            label: number,
            ray: hit.ray,
            chi2: hit.chi2,
            is_vote: voters.binary_search(&hit.ray).is_ok(),
        })
        .collect()
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

/// Decide the claims of one pass, ordered by image.
fn decide(
    scene: &Scene,
    noise: &Noise,
    labels: &[Label],
    limit: f64,
    claims: &[Claim],
    progress: &Progress,
) -> Result<Vec<Decision>, Halt> {
    let [first, last] = [&claims[0], &claims[claims.len() - 1]].map(|claim| &scene.views[claim.image as usize]);
    let mut elsewhere: FxHashMap<u32, Estimate> = FxHashMap::default();
    for claim in claims {
        let label = &labels[claim.label as usize];
        elsewhere.entry(claim.label).or_insert_with(|| estimate_elsewhere(scene, noise, label, first, last));
    }
    let cases: Vec<Case<'_>> =
        claims.iter().filter_map(|claim| Case::of(scene, noise, &elsewhere[&claim.label], claim)).collect();
    let images: Vec<&[Case<'_>]> = cases.chunk_by(|a, b| a.claim.image == b.claim.image).collect();
    let driven_m: Vec<f64> = images.iter().map(|cases| cases[0].look.driven_m).collect();
    let leg_of = legs(&driven_m);
    let starts: Vec<_> =
        (0..images.len()).filter(|&i| i == 0 || leg_of[i] != leg_of[i - 1]).map(|i| driven_m[i]).collect();
    let votes: Vec<Belief> = images.iter().map(|cases| belief_of_votes(cases)).collect();
    let mut of_legs = vec![Belief::nothing(); starts.len()];
    for (vote, &leg) in votes.iter().zip(&leg_of) {
        of_legs[leg] = of_legs[leg].and(vote);
    }
    let smoothed = smooth(&starts, &of_legs);
    let judge = |((cases, vote), &leg): ((&&[Case<'_>], &Belief), &usize)| {
        let view = &scene.views[cases[0].claim.image as usize];
        // Its own votes are what is in question.
        let pose = smoothed[leg].without(vote).pose_error(noise.shared(view), noise.of_image(view));
        progress.check()?;
        Ok(grant(cases, limit, &pose))
    };
    let mut fits: Vec<Vec<Fit>> = images.iter().zip(&votes).zip(&leg_of).map(judge).collect::<Result<_, Halt>>()?;
    let overruled = overruled(scene, noise, &elsewhere, &images, &fits, limit, progress)?;
    let mut decisions = Vec::new();
    for (cases, fits) in images.iter().zip(&mut fits) {
        overrule(cases, fits, &overruled, limit);
        report(cases, fits, labels, limit, &mut decisions);
    }
    Ok(decisions)
}

/// Where the other passes put a label: votes of this pass that went to the wrong one of two labels must not confirm
/// themselves. They keep a small weight, for where the other passes tell little.
fn estimate_elsewhere(scene: &Scene, noise: &Noise, label: &Label, first: &View, last: &View) -> Estimate {
    let is_here =
        |view: &View| view.pass == first.pass && view.driven_m >= first.driven_m && view.driven_m <= last.driven_m;
    let voters = by_pass(scene, &label.voters).find(|voters| voters.iter().any(|&ray| is_here(scene.view(ray))));
    let rest = label.voters.len() - voters.map_or(0, <[u32]>::len);
    let of_pass =
        voters.filter(|_| rest >= 2).and_then(|voters| pass_terms(scene, noise, voters, &label.estimate.point));
    let moved = of_pass.and_then(|terms| {
        let all = label.estimate.covariance.try_inverse()?;
        let covariance = (all - terms.information * OTHERS_SHARE).cholesky()?.inverse();
        let step = covariance * terms.gradient * OTHERS_SHARE;
        (step.norm() < LONGEST_STEP_M).then_some(Estimate { point: label.estimate.point + step, covariance })
    });
    moved.unwrap_or(label.estimate)
}

impl<'a> Case<'a> {
    fn of(scene: &Scene, noise: &Noise, estimate: &Estimate, claim: &'a Claim) -> Option<Self> {
        let look = Look::of(scene, noise, claim.ray, &estimate.point)?;
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
fn belief_of_votes(cases: &[Case<'_>]) -> Belief {
    cases.iter().filter(|case| case.claim.is_vote).fold(Belief::nothing(), |sum, case| {
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
    /// What they show.
    rays: Vec<u32>,
}

/// Pairs of labels (the better one, the other) of which a pass shows only one, where it might be either: there is one
/// object, and the other label is not to be seen from there.
fn overruled(
    scene: &Scene,
    noise: &Noise,
    elsewhere: &FxHashMap<u32, Estimate>,
    images: &[&[Case<'_>]],
    fits: &[Vec<Fit>],
    limit: f64,
    progress: &Progress,
) -> Result<FxHashSet<(u32, u32)>, Halt> {
    let mut rivalries: FxHashMap<(u32, u32), Rivalry> = FxHashMap::default();
    for (cases, fits) in images.iter().zip(fits) {
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
                        rivalry.rays.push(a.ray);
                    }
                }
            }
        }
    }
    let is_one = |r: &Rivalry| r.one >= LEAST_RIVALRY && f64::from(r.both) < MOST_BOTH * f64::from(r.one);
    let of_pair = |((a, b), mut rivalry): ((u32, u32), Rivalry)| {
        rivalry.rays.sort_unstable();
        let [of_a, of_b] = [a, b].map(|label| surprise(scene, noise, &rivalry.rays, &elsewhere[&label]));
        if of_a <= of_b { (a, b) } else { (b, a) }
    };
    Ok(rivalries.into_iter().filter(|(_, r)| is_one(r)).map(of_pair).collect())
}

/// Minus twice the logarithm of the likelihood that rays of one pass show a label of which an estimate is known, up to what
/// is the same for all labels: together they may move the estimate once.
fn surprise(scene: &Scene, noise: &Noise, rays: &[u32], estimate: &Estimate) -> f64 {
    let joint = || {
        let terms = pass_terms(scene, noise, rays, &estimate.point)?;
        let known = estimate.covariance.try_inverse()?;
        let after = (terms.information + known).cholesky()?;
        let widening = (after.determinant() * estimate.covariance.determinant()).ln();
        Some(terms.square - terms.gradient.dot(&after.solve(&terms.gradient)) + widening)
    };
    joint().unwrap_or(f64::INFINITY)
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
