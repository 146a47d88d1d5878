//! Positions and covariances: least squares over the votes, with the errors of the poses marginalised.
//!
//! Each visit of a pass gives its normal equations with its pose errors taken out ([`drift`](crate::robust::noise::drift)). Their sum is the
//! information of the positions, and its inverse the covariance. A label alone cannot tell an error of its pass from one of its
//! own position; its neighbours in the same images can. So labels may be estimated together: a bundle adjustment with priors on
//! the poses.

use std::iter::repeat_n;
use std::ops::Range;

use nalgebra::{DMatrix, DVector, Matrix3, Vector2, Vector3};
use rustc_hash::FxHashMap;

use super::height_terms;
use super::sides::sides;
use super::sizes::size_terms;
use crate::robust::model::Model;
use crate::robust::model::ranges::range_terms;
use crate::robust::noise::drift::{Drive, Look, Normals, Vantage, segments};
use crate::robust::noise::huber::huber_weight;
use crate::robust::noise::spd::Vector6;
use crate::robust::noise::{Noise, variance_of_alike};
use crate::robust::parts::Part;
use crate::robust::scene::{Scene, View};

/// A pass that comes back after so long a drive has another drift, m. Less than a tenth of the old one is left then (`DRIFT_LENGTH_M`).
const FORGOTTEN_M: f64 = 250.0;
/// A longer step is shortened to this, m. Over more, residuals of nearby cameras are not linear.
pub const LONGEST_STEP_M: f64 = 5.0;
/// A step that leads behind a voter is cut to a quarter, so many times at most. The last leaves a millimetre of the longest step.
const MAX_CUTS: i32 = 6;
/// Votes are judged once a step is shorter than this, in sigmas, root mean square of the labels. Residuals hardly change by more then, which is little beside
/// the gate.
const NEAR_SIGMAS: f64 = 0.3;
/// Rounds of leaving out votes, at most. It bounds the work: after each the labels are estimated anew.
const MAX_TRIMS: usize = 10;
/// How much of what a visit says is left out when it is judged: a little stays, for where the others tell nothing.
const OTHERS_SHARE: f64 = 0.95;
/// Farther than this the linear step to where the other visits put a label is not trusted, m. It is less than `LONGEST_STEP_M`, as nothing is evaluated anew
/// where it leads.
const LONGEST_MOVE_M: f64 = 3.0;

/// How much care an estimate takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Care {
    /// Good enough while votes may still change: each label has an image's own error for itself, at the measured poses.
    Rough,
    /// Good for good: labels share what their images get wrong, and all is linearised where the images probably were.
    Exact,
}

impl Care {
    /// Estimates are done when a step is shorter than this, in sigmas, root mean square of the labels.
    fn tolerance_sigmas(self) -> f64 {
        match self {
            Self::Rough => 0.05,
            Self::Exact => super::STEP_SIGMAS,
        }
    }

    fn max_iterations(self) -> usize {
        match self {
            Self::Rough => 5,
            Self::Exact => 20,
        }
    }
}

/// A position with its covariance, m².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Position in the world, m.
    pub point: Vector3<f64>,
    /// Covariance, m².
    pub covariance: Matrix3<f64>,
}

/// Where all visits but one put a label.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Elsewhere {
    /// The pass of that one.
    pub pass: u32,
    /// From where to where it voted, m driven.
    pub driven_m: [f64; 2],
    /// What the others say.
    pub estimate: Estimate,
}

impl Elsewhere {
    /// Whether a view is of the visit that is left out.
    #[must_use]
    pub fn leaves_out(&self, view: &View) -> bool {
        let [first, last] = self.driven_m;
        view.pass == self.pass && view.driven_m > first - FORGOTTEN_M && view.driven_m < last + FORGOTTEN_M
    }
}

/// Where the estimation of a label begins.
pub struct Start<'v> {
    /// Its voters.
    pub voters: &'v [u32],
    /// How much each of them counted when it was last estimated; none if it was not.
    pub weights: &'v [f64],
    /// A point near it.
    pub point: Vector3<f64>,
}

/// Which votes leave while labels are estimated.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Those with a larger residual, in their own sigmas, the drift of their visit taken out.
    pub gate_sigmas: f64,
    /// All of a label with fewer than so many.
    pub min_votes: usize,
}

/// Labels that are estimated together.
///
/// Where each side of a label shows another middle, the middles are points as well, each tied to its label.
#[derive(Clone)]
pub struct Joint<'a> {
    scene: &'a Scene,
    /// Label and ray of each vote, by visit and image.
    votes: Vec<(usize, u32)>,
    /// The point that each of them sees: the label's, or the middle of its side.
    seen: Vec<usize>,
    /// From where each is cast.
    vantages: Vec<Vantage>,
    weights: Vec<f64>,
    /// The most probable pose error of the image of each vote, m and rad.
    pose_errors: Vec<Vector6>,
    /// Those of the labels, then those of middles.
    points: Vec<Vector3<f64>>,
    /// The label of each middle.
    label_of_middle: Vec<usize>,
    /// Standard deviation of a middle beside its label, each axis, m.
    side_m: f64,
    care: Care,
    /// What is learned about sizes and heights, if they serve.
    model: Option<&'a Model<'a>>,
}

/// Labels estimated together.
pub struct Solution<'a> {
    joint: Joint<'a>,
    here: Evaluation,
    /// Label and ray of the votes that left.
    pub refused: Vec<(usize, u32)>,
    /// The positions with their covariances.
    pub estimates: Vec<Estimate>,
}

impl<'a> Joint<'a> {
    /// Begin with some labels.
    #[must_use]
    pub fn new<'v>(scene: &'a Scene, noise: &'a Noise, labels: impl Iterator<Item = Start<'v>>, care: Care) -> Self {
        let (mut counted, mut points) = (Vec::new(), Vec::new());
        for (label, Start { voters, weights, point }) in labels.enumerate() {
            let weight = |i: usize| weights.get(i).copied().unwrap_or(1.0);
            counted.extend(voters.iter().enumerate().map(|(i, &ray)| ((label, ray), weight(i))));
            points.push(point);
        }
        counted.sort_by_key(|&((label, ray), _)| (scene.view(ray).pass, ray, label));
        let pose_errors = vec![Vector6::zeros(); counted.len()];
        let vantages = counted.iter().map(|&((_, ray), _)| Vantage::of(scene, noise, ray)).collect();
        let (votes, weights): (Vec<(usize, u32)>, Vec<f64>) = counted.into_iter().unzip();
        let seen = votes.iter().map(|(label, _)| *label).collect();
        let (label_of_middle, side_m) = (Vec::new(), noise.side_m);
        let all = Self {
            scene,
            votes,
            seen,
            vantages,
            weights,
            pose_errors,
            points,
            label_of_middle,
            side_m,
            care,
            model: None,
        };
        let all = if noise.look_correlation > 0.0 { all.with_memory(noise.look_correlation) } else { all };
        if side_m > 0.0 { all.with_middles() } else { all }
    }

    /// Let successive looks at a label be off alike. What an image is off by itself all its labels share: it counts as for the one with the most looks.
    fn with_memory(mut self, correlation: f64) -> Self {
        let mut of_labels: Vec<Vec<usize>> = vec![Vec::new(); self.points.len()];
        for (i, &(label, _)) in self.votes.iter().enumerate() {
            of_labels[label].push(i);
        }
        let mut times = vec![1.0; self.votes.len()];
        for of_label in of_labels {
            let rays: Vec<u32> = of_label.iter().map(|&i| self.votes[i].1).collect();
            for (i, of_look) in of_label.into_iter().zip(times_of_alike(self.scene, &rays, correlation)) {
                times[i] = of_look;
            }
        }
        let image = |vote: &(usize, u32)| self.scene.image_of(vote.1);
        let mut at = 0;
        for of_image in self.votes.chunk_by(|a, b| image(a) == image(b)) {
            let votes = at..at + of_image.len();
            let most = times[votes.clone()].iter().copied().fold(1.0, f64::max);
            for i in votes.clone() {
                self.vantages[i] = self.vantages[i].clone().with_variance(most, times[i]);
            }
            at = votes.end;
        }
        self
    }

    /// Let the votes from each side of a label see a point of their own.
    fn with_middles(mut self) -> Self {
        let mut of_labels: Vec<Vec<(u32, usize)>> = vec![Vec::new(); self.points.len()];
        for (i, &(label, ray)) in self.votes.iter().enumerate() {
            of_labels[label].push((ray, i));
        }
        for (label, votes) in of_labels.iter().enumerate() {
            let rays: Vec<u32> = votes.iter().map(|(ray, _)| *ray).collect();
            let visits: Vec<&[u32]> = visits(self.scene, &rays).collect();
            let sides = sides(self.scene, visits.iter().copied());
            let mut end = 0;
            for (visit, rays) in (0..).zip(&visits) {
                let side = sides.iter().position(|side| side.contains(&visit)).unwrap_or(0);
                for &(_, i) in &votes[end..end + rays.len()] {
                    self.seen[i] = self.points.len() + side;
                }
                end += rays.len();
            }
            self.points.extend(vec![self.points[label]; sides.len()]);
            self.label_of_middle.extend(vec![label; sides.len()]);
        }
        self
    }

    /// Information about a middle beside its label, 1/m².
    fn tie(&self) -> Matrix3<f64> {
        Matrix3::identity() / (self.side_m * self.side_m)
    }

    fn labels(&self) -> usize {
        self.points.len() - self.label_of_middle.len()
    }

    /// Let sizes and heights tell where labels are, too.
    #[must_use]
    pub fn with_priors(self, model: &'a Model<'a>) -> Self {
        Self { model: Some(model), ..self }
    }

    /// Estimate the positions. Labels without votes stay where they are.
    ///
    /// Nothing if one ends up behind a voter, or the votes do not fix them.
    #[must_use]
    pub fn solve(self) -> Option<Solution<'a>> {
        self.solve_within(&Limits { gate_sigmas: f64::INFINITY, min_votes: 0 })
    }

    /// Estimate the positions, and leave votes out that do not fit.
    ///
    /// Nothing if one ends up behind a voter, or the votes do not fix them.
    #[must_use]
    pub fn solve_within(mut self, limits: &Limits) -> Option<Solution<'a>> {
        let mut here = self.evaluate()?;
        let mut rounds = 1;
        let mut trims = 0;
        let mut refused = Vec::new();
        let information = loop {
            let information = here.normals.information.clone().cholesky()?;
            let step = -information.solve(&here.normals.gradient);
            let length_sigmas = (-step.dot(&here.normals.gradient) / self.labels() as f64).sqrt();
            self.step(&step);
            self.weights = here.own.iter().map(|&chi2| huber_weight(chi2)).collect();
            if self.care == Care::Exact {
                self.pose_errors.clone_from(&here.pose_errors);
            }
            let is_last = rounds == self.care.max_iterations();
            if trims < MAX_TRIMS
                && (is_last || length_sigmas < NEAR_SIGMAS)
                && self.trim(&here.own, limits, &mut refused)
            {
                trims += 1;
                rounds = 0;
            } else if is_last || length_sigmas < self.care.tolerance_sigmas() {
                break information;
            }
            here = self.evaluate()?;
            rounds += 1;
        };
        // The last step may have gone behind a voter.
        self.is_in_front().then_some(())?;
        let mut estimates = self.estimates(&information.inverse());
        estimates.truncate(self.labels());
        Some(Solution { joint: self, here, refused, estimates })
    }

    /// Leave out votes with the residuals `own`, see [`Evaluation`], that do not fit; whether there were any.
    fn trim(&mut self, own: &[f64], limits: &Limits, refused: &mut Vec<(usize, u32)>) -> bool {
        let mut leaves = unfit(&self.votes, own, limits.gate_sigmas);
        if !leaves.contains(&true) {
            return false;
        }
        let mut left = vec![0; self.labels()];
        for ((label, _), leaves) in self.votes.iter().zip(&leaves) {
            left[*label] += usize::from(!leaves);
        }
        for ((label, _), leaves) in self.votes.iter().zip(&mut leaves) {
            *leaves |= left[*label] < limits.min_votes;
        }
        refused.extend(self.votes.iter().zip(&leaves).filter(|(_, leaves)| **leaves).map(|(vote, _)| *vote));
        self.leave_out(&leaves);
        true
    }

    fn leave_out(&mut self, leaves: &[bool]) {
        retain(&mut self.votes, leaves);
        retain(&mut self.seen, leaves);
        retain(&mut self.vantages, leaves);
        retain(&mut self.weights, leaves);
        retain(&mut self.pose_errors, leaves);
    }

    /// Move the points, each not too far, and none behind a voter if a part of the way is not.
    fn step(&mut self, step: &DVector<f64>) {
        let from = self.points.clone();
        for share in shares_of_step() {
            for (k, (point, from)) in self.points.iter_mut().zip(&from).enumerate() {
                let step = step.fixed_rows::<3>(3 * k);
                *point = from + step * (share * (LONGEST_STEP_M / step.norm()).min(1.0));
            }
            if self.is_in_front() {
                break;
            }
        }
    }

    /// Whether all points are in front of their voters.
    fn is_in_front(&self) -> bool {
        self.votes
            .iter()
            .zip(&self.seen)
            .all(|(&(_, ray), &point)| self.scene.ray(ray).project(&self.points[point]).z > 0.0)
    }

    fn estimates(&self, covariance: &DMatrix<f64>) -> Vec<Estimate> {
        let block = |k: usize| covariance.fixed_view::<3, 3>(3 * k, 3 * k).into_owned();
        self.points.iter().enumerate().map(|(k, &point)| Estimate { point, covariance: block(k) }).collect()
    }

    fn visits(&self) -> impl Iterator<Item = &[(usize, u32)]> {
        self.votes.chunk_by(|a, b| is_one_visit(self.scene.view(a.1), self.scene.view(b.1)))
    }

    fn evaluate(&self) -> Option<Evaluation> {
        let of_labels = if self.model.is_some() { self.votes_of_labels() } else { Vec::new() };
        let OfVisits { looks, weights, is_vote, visits } = self.looks(&of_labels)?;
        let mut normals = Normals::nothing(self.points.len());
        self.add_ties(&mut normals);
        let (mut of_visits, mut pose_errors) = (Vec::with_capacity(visits.len()), Vec::new());
        let mut left: Vec<Vector2<f64>> = Vec::with_capacity(looks.len());
        for (labels, end) in visits {
            let range = left.len()..end;
            let drive = Drive::along(&looks[range.clone()], &weights[range.clone()], labels.len())?;
            normals.add_those_of(&labels, &drive.normals);
            left.extend(drive.left());
            if self.care == Care::Exact {
                let errors = drive.pose_errors(&weights[range.clone()]).into_iter().zip(&is_vote[range]);
                pose_errors.extend(errors.filter(|(_, is_vote)| **is_vote).map(|(error, _)| error));
            }
            of_visits.push((labels, drive.normals));
        }
        let votes = || {
            let of_votes = (0..looks.len()).filter(|&i| is_vote[i]).map(|i| (&looks[i], weights[i], &left[i]));
            self.seen.iter().copied().zip(of_votes)
        };
        let mut alone = vec![Matrix3::zeros(); self.points.len()];
        alone[self.labels()..].fill(self.tie());
        for (point, (look, weight, _)) in votes() {
            for column in &look.by_point {
                alone[point] += column * column.transpose() * (weight / look.variance);
            }
        }
        let mut has_votes = vec![false; self.labels()];
        self.votes.iter().for_each(|(label, _)| has_votes[*label] = true);
        // Labels without votes stay where they are.
        for (label, _) in has_votes.iter().enumerate().filter(|(_, has_votes)| !**has_votes) {
            normals.add(label, label, &Matrix3::identity());
        }
        let covariance = |alone: Matrix3<f64>| {
            let is_nothing = alone == Matrix3::zeros();
            if is_nothing { Some(Matrix3::identity()) } else { Some(alone.cholesky()?.inverse()) }
        };
        let alone: Vec<Matrix3<f64>> = alone.into_iter().map(covariance).collect::<Option<_>>()?;
        let own = votes().map(|(point, (look, weight, left))| look.studentised(left, &alone[point], weight)).collect();
        self.add_priors(&of_labels, &mut normals);
        Some(Evaluation { normals, of_visits, own, pose_errors })
    }
}

/// The looks of some votes, visit by visit, and what heights say as further ones.
struct OfVisits {
    /// Each at a point by its place among those of its visit: most visits see few of many.
    looks: Vec<Look>,
    weights: Vec<f64>,
    is_vote: Vec<bool>,
    /// The points of each visit, ascending, and where it ends.
    visits: Vec<(Vec<usize>, usize)>,
}

impl Joint<'_> {
    /// What is seen of the labels where they are; nothing if one is behind a voter. What heights say goes among the looks: the visit's drift is theirs
    /// as well.
    fn looks(&self, of_labels: &[Vec<u32>]) -> Option<OfVisits> {
        let heights = self.heights(of_labels);
        let count = self.votes.len() + heights.len();
        let mut found = OfVisits {
            looks: Vec::with_capacity(count),
            weights: Vec::with_capacity(count),
            is_vote: Vec::with_capacity(count),
            visits: Vec::new(),
        };
        let mut at = 0;
        for votes in self.visits() {
            let mut points = self.seen[at..at + votes.len()].to_vec();
            points.extend((at..).zip(votes).filter(|(i, _)| heights.contains_key(i)).map(|(_, (label, _))| *label));
            points.sort_unstable();
            points.dedup();
            let place = |point: usize| points.partition_point(|&before| before < point);
            for (i, &(label, _)) in (at..).zip(votes) {
                let (vantage, point) = (&self.vantages[i], &self.points[self.seen[i]]);
                let look = match self.care {
                    Care::Rough => vantage.look(place(self.seen[i]), point)?.by_itself(),
                    Care::Exact => vantage.look_where_it_was(place(self.seen[i]), point, &self.pose_errors[i])?,
                };
                let height = heights.get(&i).map(|(up, higher_m, m2)| look.at_height(place(label), up, *higher_m, *m2));
                found.looks.push(look);
                found.weights.push(self.weights[i]);
                found.is_vote.push(true);
                if let Some(height) = height {
                    found.looks.push(height);
                    found.weights.push(1.0);
                    found.is_vote.push(false);
                }
            }
            at += votes.len();
            found.visits.push((points, found.looks.len()));
        }
        Some(found)
    }

    /// Add that each middle is about where its label is.
    fn add_ties(&self, normals: &mut Normals) {
        let tie = self.tie();
        for (middle, &label) in (self.labels()..).zip(&self.label_of_middle) {
            let pull = tie * (self.points[middle] - self.points[label]);
            normals.add(middle, middle, &tie);
            normals.add(label, label, &tie);
            normals.add(middle, label, &-tie);
            normals.add(label, middle, &-tie);
            normals.add_gradient(middle, &pull);
            normals.add_gradient(label, &-pull);
        }
    }

    /// Add what measured ranges and sizes say of the labels.
    fn add_priors(&self, of_labels: &[Vec<u32>], normals: &mut Normals) {
        let has_ranges = self.model.is_none_or(|model| model.settings.has(Part::Ranges));
        let of_ranges =
            self.votes.iter().zip(&self.vantages).filter(|_| has_ranges).filter_map(|(&(label, _), vantage)| {
                Some((label, range_terms(vantage.range_m, vantage.center(), &self.points[label])?))
            });
        let of_sizes = of_labels
            .iter()
            .enumerate()
            .filter_map(|(label, votes)| Some((label, size_terms(self.model?, votes, &self.points[label])?)));
        for (label, prior) in of_ranges.chain(of_sizes) {
            normals.add(label, label, &prior.information);
            normals.add_gradient(label, &prior.gradient);
        }
    }

    /// The rays that vote for each label.
    fn votes_of_labels(&self) -> Vec<Vec<u32>> {
        let mut votes: Vec<Vec<u32>> = vec![Vec::new(); self.labels()];
        for &(label, ray) in &self.votes {
            votes[label].push(ray);
        }
        votes
    }

    /// What is known of heights, by the number of the vote whose image it is said of, the nearest of each visit: what is up, how much too high its label
    /// is, m, and the variance of that, m². A height is above cameras, so how high these are is as unknown to it as to the votes; each visit has
    /// as large a share of what it tells.
    fn heights(&self, of_labels: &[Vec<u32>]) -> FxHashMap<usize, (Vector3<f64>, f64, f64)> {
        let mut found = FxHashMap::default();
        let Some(model) = self.model else { return found };
        let mut nearest: Vec<Vec<(f64, usize)>> = vec![Vec::new(); self.labels()];
        let mut at = 0;
        for votes in self.visits() {
            let mut of_visit: FxHashMap<usize, (f64, usize)> = FxHashMap::default();
            for (i, &(label, ray)) in (at..).zip(votes) {
                let distance_m = (self.scene.ray(ray).center - self.points[label]).norm();
                let best = of_visit.entry(label).or_insert((distance_m, i));
                if distance_m < best.0 {
                    *best = (distance_m, i);
                }
            }
            for (label, best) in of_visit {
                nearest[label].push(best);
            }
            at += votes.len();
        }
        for ((votes, point), nearest) in of_labels.iter().zip(&self.points).zip(&nearest) {
            let Some((up, terms)) = height_terms(model, votes, point, 0.0) else { continue };
            // What tells less than that an object is in range tells nothing.
            if terms.information * model.settings.viability.max_range_m.powi(2) > 1.0 {
                let (higher_m, variance_m2) = (terms.gradient / terms.information, terms.information.recip());
                for &(_, i) in nearest {
                    found.insert(i, (up, higher_m, variance_m2 * nearest.len() as f64));
                }
            }
        }
        found
    }
}

impl Solution<'_> {
    /// Squared residuals of all votes in sigmas, pose errors taken out.
    #[must_use]
    pub fn square(&self) -> f64 {
        self.here.normals.square
    }

    /// Label and ray of each vote.
    #[must_use]
    pub fn votes(&self) -> &[(usize, u32)] {
        &self.joint.votes
    }

    /// How much each of the [votes](Self::votes) counts.
    #[must_use]
    pub fn weights(&self) -> &[f64] {
        &self.joint.weights
    }

    /// To first order, the estimates without those of the [votes](Self::votes) of which `leaves` says so; nothing if the others do not fix them.
    #[must_use]
    pub fn without(&self, leaves: &[bool]) -> Option<Vec<Estimate>> {
        let mut rest = self.joint.clone();
        rest.leave_out(leaves);
        let Evaluation { normals, .. } = rest.evaluate()?;
        let information = normals.information.cholesky()?;
        rest.step(&-information.solve(&normals.gradient));
        let mut estimates = rest.estimates(&information.inverse());
        estimates.truncate(rest.labels());
        Some(estimates)
    }

    /// For each label, where all visits but one put it, for each that votes for it: votes of a visit that went to the wrong one of
    /// two labels must not confirm themselves.
    #[must_use]
    pub fn elsewhere(&self) -> Vec<Vec<Elsewhere>> {
        let Self { joint, here, .. } = self;
        let mut found = vec![Vec::new(); joint.labels()];
        let mut voters = vec![0_usize; joint.labels()];
        for &(label, _) in &joint.votes {
            voters[label] += 1;
        }
        let mut at = 0;
        for (votes, (points, of_visit)) in joint.visits().zip(&here.of_visits) {
            let mut all = Normals::nothing(joint.points.len());
            all.add_those_of(points, of_visit);
            // What the visit sees of each label that it votes for.
            let seen: FxHashMap<usize, usize> =
                votes.iter().zip(&joint.seen[at..]).map(|(&(label, _), &point)| (label, point)).collect();
            at += votes.len();
            let rest = &here.normals.information - all.information * OTHERS_SHARE;
            let Some(rest) = rest.cholesky() else { continue };
            let step = rest.solve(&(all.gradient * OTHERS_SHARE - &here.normals.gradient));
            let others = joint.estimates(&rest.inverse());
            let mut of_visit = vec![0_usize; joint.labels()];
            for &(label, _) in votes {
                of_visit[label] += 1;
            }
            let view = |vote: &(usize, u32)| joint.scene.view(vote.1);
            let driven_m = [view(&votes[0]), view(&votes[votes.len() - 1])].map(|view| view.driven_m);
            for (label, found) in found.iter_mut().enumerate() {
                let Some(&point) = seen.get(&label) else { continue };
                let (step, mut estimate) = (step.fixed_rows::<3>(3 * point), others[point]);
                if voters[label] >= of_visit[label] + 2 && step.norm() < LONGEST_MOVE_M {
                    estimate.point += step;
                    found.push(Elsewhere { pass: view(&votes[0]).pass, driven_m, estimate });
                }
            }
        }
        found
    }
}

/// All of a step, and less and less of it, for where it leads behind a voter: far away residuals are linear, nearby they are not.
pub fn shares_of_step() -> impl Iterator<Item = f64> {
    (0..=MAX_CUTS).map(|cuts| 0.25_f64.powi(cuts))
}

/// Which votes with the residuals `own` do not fit the gate and must leave: of each label the worst first, since one bad
/// vote makes good ones look bad.
fn unfit(votes: &[(usize, u32)], own: &[f64], gate_sigmas: f64) -> Vec<bool> {
    let labels = votes.iter().map(|(label, _)| label + 1).max().unwrap_or(0);
    let mut worst = vec![0.0_f64; labels];
    for ((label, _), chi2) in votes.iter().zip(own) {
        worst[*label] = worst[*label].max(*chi2);
    }
    let limit = gate_sigmas * gate_sigmas;
    let stays = |((label, _), chi2): (&(usize, u32), &f64)| *chi2 < limit || *chi2 < 0.5 * worst[*label];
    votes.iter().zip(own).map(|vote| !stays(vote)).collect()
}

/// Leave out what is said to leave.
fn retain<T>(all: &mut Vec<T>, leaves: &[bool]) {
    let mut leaves = leaves.iter();
    all.retain(|_| leaves.next() == Some(&false));
}

/// The normal equations of all votes, and how well each fits.
struct Evaluation {
    normals: Normals,
    /// Of the points of each visit, ascending.
    of_visits: Vec<(Vec<usize>, Normals)>,
    /// Squared residual of each vote in its own sigmas, after the drift of its visit is taken out, studentised: a vote that pulls the point towards
    /// itself has a small residual, and is expected to.
    own: Vec<f64>,
    /// The most probable pose error of the image of each vote; none while estimates are rough.
    pose_errors: Vec<Vector6>,
}

/// Whether two views, successive among those of something, are of one visit: of a pass that has not forgotten its drift.
#[must_use]
pub fn is_one_visit(a: &View, b: &View) -> bool {
    a.pass == b.pass && (b.driven_m - a.driven_m).abs() < FORGOTTEN_M
}

/// Voters in runs of one visit.
pub fn visits<'a>(scene: &'a Scene, voters: &'a [u32]) -> impl Iterator<Item = &'a [u32]> {
    voters.chunk_by(|&a, &b| is_one_visit(scene.view(a), scene.view(b)))
}

/// Where the runs of one visit each are among voters.
pub(crate) fn ranges_of_visits(scene: &Scene, voters: &[u32]) -> Vec<Range<usize>> {
    let mut end = 0;
    let of_visit = |visit: &[u32]| {
        end += visit.len();
        end - visit.len()..end
    };
    visits(scene, voters).map(of_visit).collect()
}

/// Cameras no farther apart than this share of the distance are in one place: what crosses at so small an angle is less than a pixel apart.
const ONE_PLACE: f64 = 1e-3;

/// The looks of the voters of one visit at a point, each by itself, along the lines of sight that a noise makes probable; nothing if it is behind
/// one of them. Lines from where cameras of one place probably are would cross anywhere, and a step along them would explain all residuals: these look from
/// where they are said to be.
#[must_use]
pub fn looks_at(
    scene: &Scene,
    noise: &Noise,
    of_sight: &Noise,
    voters: &[u32],
    point: &Vector3<f64>,
) -> Option<Vec<Look>> {
    // Not collected: an iterator of options does not say how many there will be.
    let mut looks = Vec::with_capacity(voters.len());
    let is_one_place = are_in_one_place(scene, voters, point);
    for &ray in voters {
        let vantage = Vantage::of(scene, noise, ray).with_sight_of(scene, of_sight, ray);
        let vantage = if is_one_place { vantage.as_said() } else { vantage };
        looks.push(vantage.look(0, point)?.by_itself());
    }
    if noise.look_correlation > 0.0 {
        for (look, times) in looks.iter_mut().zip(times_of_alike(scene, voters, noise.look_correlation)) {
            (look.detection_px2, look.variance) = (look.detection_px2 * times, look.variance * times);
        }
    }
    Some(looks)
}

/// Whether the cameras of some voters are in one place, as of a car that stands or on a mast, as far as a point tells.
fn are_in_one_place(scene: &Scene, voters: &[u32], point: &Vector3<f64>) -> bool {
    let Some(&first) = voters.first() else { return true };
    let here = scene.ray(first).center;
    let reach_m = ONE_PLACE * (point - here).norm();
    voters.iter().all(|&ray| (scene.ray(ray).center - here).norm_squared() <= reach_m * reach_m)
}

/// How many times as large the variance of each voter of one label is, if successive looks of a segment are off alike.
fn times_of_alike(scene: &Scene, voters: &[u32], correlation: f64) -> Vec<f64> {
    let driven_m = |&ray: &u32| scene.view(ray).driven_m;
    let segments = visits(scene, voters).flat_map(|visit| segments(visit, driven_m));
    segments.flat_map(|looks| repeat_n(variance_of_alike(looks.len(), correlation), looks.len())).collect()
}
