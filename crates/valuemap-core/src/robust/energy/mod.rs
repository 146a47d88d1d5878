//! J: minus twice the logarithm of how much more probable a map is than that all detections are clutter.
//!
//! J is a sum over objects. The symbols are those of `docs/method.md`; for an object of class c with n votes i in visits v:
//!
//! ```text
//! J = sum_v [ r' C^-1 r + ln|C| ] + 2 n ln 2 pi       (1) residuals, errors of poses and middles marginalised
//!   + ln|information| - 3 ln 2 pi - 2 ln births_c     (2) the position, marginalised, and the price of a birth
//!   + 2 sum_i ln clutter_c                            (3) what the votes are otherwise
//!   - 2 sum_i [ ln ratio(size_i) + ln ratio(range_i) + ln ratio(score_i) + ln share_c(class_i) ]
//!   - 2 ln prior_c(size)                              (4) what a detection says beyond its centre
//!   - 2 ln [ real(looks) + false(looks) ] + 2 sum_w [ ln binomial(images_w, hits_w) - hit_w ln reach_c(distance_w) ]
//!                                                     (5) the looks, by side, pass and viewpoint w
//! ```
//!
//! In (5) `false` is a false thing: parked, reflected, or regularly mistaken for an object. Its detections meet as those of an object do, but on one pass
//! alone or in fewer of the looks. Or it is a ghost: rays that meet by chance, in hardly any of the looks (see [`seen`]).

pub mod agreement;
pub mod estimate;
pub mod extent;
pub mod looks;
pub mod places;
pub mod seen;
pub mod sides;
pub mod sizes;

use std::f64::consts::PI;
use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

use crate::robust::model::heights::{HeightTerms, height_m};
use crate::robust::model::{Model, Sizes, median};
use crate::robust::noise::drift::{Drive, OneLook, Vantage, looks_by_themselves};
use crate::robust::noise::huber::{HUBER_SIGMAS, huber_weight};
use crate::robust::parts::Part;
use crate::robust::scene::Scene;
use estimate::{ranges_of_visits, visits};
use looks::Lookout;
use places::ByPlace;
use seen::{Seen, Shares};
use sides::{LEAST_COSINE, Middle, Said, marginalised, sides};
use sizes::size_terms;

/// The position is found when a step is shorter than this, in its own sigmas. What is left adds a thousandth to the variance of the position.
const STEP_SIGMAS: f64 = 0.03;
/// Steps, at most: it bounds the work where weights and position follow each other slowly.
const MAX_STEPS: usize = 12;
/// Times that a step after which the residuals are larger is cut to a quarter. The last that is tried is a thousandth of it, and less is taken for no way down.
const MAX_CUTS: usize = 6;
/// Residuals that are larger by rounding are not larger.
const LEAST_FALL: f64 = 1e-9;

/// Objects of fewer votes tell nothing of others where there are better ones: chance meetings have few. Six rays leave nine residuals to spare.
pub const SURE_VOTES: usize = 6;
/// Rays alone tell where objects of so many votes are, with three residuals to spare.
pub const LEAST_VOTES: usize = 3;
/// So many tell it with residuals to spare.
pub const TELLING_VOTES: usize = LEAST_VOTES + 1;

/// An object: what the map consists of.
#[derive(Debug, Clone)]
pub struct Object {
    /// The class of its votes.
    pub class: u32,
    /// The rays that vote for it, at most one per image, ascending.
    pub votes: Vec<u32>,
    /// Where it is, given these.
    pub fit: Fit,
    /// Logarithm of its physical size, m; not a number if its boxes do not tell.
    pub ln_size: f64,
    /// The looks at it.
    pub seen: Seen,
    /// Probability that it is real rather than false, if it is anything.
    pub real: f64,
    /// Its share of J.
    pub energy: f64,
}

/// Votes (ascending) and a position.
pub type Placed = (Vec<u32>, Vector3<f64>);

/// Votes and positions of objects.
#[must_use]
pub fn placed(objects: &[Object]) -> Vec<Placed> {
    objects.iter().map(|object| (object.votes.clone(), object.fit.point)).collect()
}

/// A position that makes some votes most probable.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The position in the world, m.
    pub point: Vector3<f64>,
    /// Its covariance, m², the poses of other objects' images unknown.
    pub covariance: Matrix3<f64>,
    /// Equation (1) and the first term of (2).
    pub energy: f64,
    /// Squared residual of each vote in sigmas, the drift of its visit taken out.
    pub chi2: Vec<f64>,
    /// What each side shows, by a direction from there; none where all show one middle.
    pub(crate) shown: Vec<Shown>,
}

/// In which direction a side is seen, and the middle that it shows.
pub(crate) type Shown = (Vector3<f64>, Middle);

impl Fit {
    /// The middle that is seen in a direction, with its covariance, m²: that of its side.
    #[must_use]
    pub fn seen_along(&self, direction: &Vector3<f64>) -> (Vector3<f64>, Matrix3<f64>) {
        let nearest = self.shown.iter().max_by(|a, b| a.0.dot(direction).total_cmp(&b.0.dot(direction)));
        nearest.map_or((self.point, self.covariance), |(_, middle)| middle.of(&self.point, &self.covariance))
    }

    /// The number of the side that is seen in a direction, if any is.
    pub(crate) fn side_along(&self, direction: &Vector3<f64>) -> Option<usize> {
        self.shown.iter().position(|(of_side, _)| of_side.dot(direction) >= LEAST_COSINE)
    }
}

/// The terms of one evaluation.
#[derive(Debug)]
pub(crate) struct Terms {
    /// Information about the position, 1/m².
    pub(crate) information: Matrix3<f64>,
    /// Gradient of half of the squared residuals, 1/m.
    pub(crate) gradient: Vector3<f64>,
    /// Equation (1) but for its constant.
    pub(crate) energy: f64,
    /// What sizes and heights add: they are judged by equations (2) and (4).
    of_priors: f64,
    /// Squared residual of each vote in sigmas, the drift of its visit taken out.
    pub(crate) chi2: Vec<f64>,
    /// What each side shows.
    middles: Vec<Middle>,
}

impl Terms {
    /// What a step must not raise.
    fn cost(&self) -> f64 {
        self.energy + self.of_priors
    }
}

/// The position of an object, by damped Gauss-Newton with Huber's weights from a point nearby. Nothing if it is behind a voter, if the votes do not
/// fix it, or if all voters are too far away to vote: without parallax, whatever the detector's noise is runs to infinity.
#[must_use]
pub fn fit(model: &Model<'_>, votes: &[u32], start: Vector3<f64>) -> Option<Fit> {
    let fitting = Fitting::new(model, votes);
    let mut weights = vec![1.0; votes.len()];
    let mut point = start;
    let mut here = fitting.terms(&weights, &point)?;
    if weights_of(&here.chi2, &mut weights) {
        here = fitting.terms(&weights, &point)?;
    }
    let mut is_weighted = true;
    for _ in 0..MAX_STEPS {
        let mut step = -here.information.cholesky()?.solve(&here.gradient);
        if -step.dot(&here.gradient) < STEP_SIGMAS * STEP_SIGMAS {
            break;
        }
        let better = (0..MAX_CUTS).find_map(|_| {
            let next = fitting.terms(&weights, &(point + step)).filter(|next| next.cost() <= here.cost() + LEAST_FALL);
            if next.is_none() {
                step *= 0.25;
            }
            next
        });
        let Some(next) = better else { break };
        point += step;
        here = next;
        is_weighted = !weights_of(&here.chi2, &mut weights);
    }
    if !is_weighted {
        here = fitting.terms(&weights, &point)?;
    }
    let cholesky = here.information.cholesky()?;
    let ln_information = 2.0 * cholesky.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
    let shown = fitting.shown(here.middles);
    is_in_reach(model, votes, &point).then(|| Fit {
        point,
        covariance: cholesky.inverse(),
        energy: here.energy + ln_information,
        chi2: here.chi2,
        shown,
    })
}

/// Whether any of some votes is cast from as near as detections vote.
fn is_in_reach(model: &Model<'_>, votes: &[u32], point: &Vector3<f64>) -> bool {
    let reach_m = model.reach_m();
    votes.iter().any(|&ray| (model.scene.ray(ray).center - point).norm() <= reach_m)
}

/// Set weights to Huber's of some squared residuals; whether any is another one now.
fn weights_of(chi2: &[f64], weights: &mut [f64]) -> bool {
    let mut any = false;
    for (weight, chi2) in weights.iter_mut().zip(chi2) {
        let new = huber_weight(*chi2);
        any |= new.to_bits() != weight.to_bits();
        *weight = new;
    }
    any
}

impl Terms {
    /// Of no vote.
    pub(crate) fn none() -> Self {
        Self {
            information: Matrix3::zeros(),
            gradient: Vector3::zeros(),
            energy: 0.0,
            of_priors: 0.0,
            chi2: Vec::new(),
            middles: Vec::new(),
        }
    }

    /// Add what the votes of one visit say.
    pub(crate) fn add(&mut self, visit: &Self) {
        self.information += visit.information;
        self.gradient += visit.gradient;
        self.energy += visit.energy;
        self.chi2.extend(&visit.chi2);
    }

    /// What is said of the position, without priors.
    pub(crate) fn said(&self) -> Said {
        Said { information: self.information, gradient: self.gradient, energy: self.energy }
    }

    /// Add what a visit or a side says.
    pub(crate) fn add_said(&mut self, said: &Said) {
        self.information += said.information;
        self.gradient += said.gradient;
        self.energy += said.energy;
    }

    /// Add what is known of sizes, ranges and heights; `camera_m2` is the [variance](camera_m2) of the cameras' heights.
    pub(crate) fn add_priors(&mut self, model: &Model<'_>, votes: &[u32], point: &Vector3<f64>, camera_m2: f64) {
        let of_ranges = votes.iter().filter_map(|&ray| model.range_terms(ray, point));
        for prior in size_terms(model, votes, point).into_iter().chain(of_ranges) {
            self.information += prior.information;
            self.gradient += prior.gradient;
            self.of_priors += prior.square;
        }
        if let Some((up, terms)) = height_terms(model, votes, point, camera_m2) {
            self.information += up * up.transpose() * terms.information;
            self.gradient += up * terms.gradient;
            self.of_priors -= 2.0 * terms.ln_density;
        }
    }
}

/// Votes whose object is sought, with what stays the same wherever it is.
struct Fitting<'a> {
    model: &'a Model<'a>,
    votes: &'a [u32],
    /// From where each is cast.
    vantages: Vec<Vantage>,
    /// The votes of each visit.
    of_visits: Vec<Range<usize>>,
    /// The numbers of the visits from each side; none where all show one middle.
    sides: Vec<Vec<u32>>,
    camera_m2: f64,
}

impl<'a> Fitting<'a> {
    fn new(model: &'a Model<'a>, votes: &'a [u32]) -> Self {
        let vantages = vantages_of(model, votes);
        let of_visits = ranges_of_visits(model.scene, votes);
        let has_sides = model.noise.side_m > 0.0;
        let sides = if has_sides { sides(model.scene, visits(model.scene, votes)) } else { Vec::new() };
        Self { model, votes, vantages, of_visits, sides, camera_m2: camera_m2(model, votes) }
    }

    /// Equation (1) at a point, with what a step needs.
    fn terms(&self, weights: &[f64], point: &Vector3<f64>) -> Option<Terms> {
        let mut sum = Terms { chi2: Vec::with_capacity(self.votes.len()), ..Terms::none() };
        if self.sides.is_empty() {
            for visit in &self.of_visits {
                let said = say(&self.vantages[visit.clone()], &weights[visit.clone()], point, &mut sum.chi2)?;
                sum.add_said(&said);
            }
        } else {
            self.add_sides(weights, point, &mut sum)?;
        }
        sum.add_priors(self.model, self.votes, point, self.camera_m2);
        sum.cost().is_finite().then_some(sum)
    }

    /// Add what each side says, the error of its middle marginalised.
    fn add_sides(&self, weights: &[f64], point: &Vector3<f64>, sum: &mut Terms) -> Option<()> {
        sum.chi2.resize(self.votes.len(), 0.0);
        for side in &self.sides {
            let (said, middle) = marginalised(self.model.noise.side_m, point, |middle| {
                let mut of_side = Terms::none();
                for &visit in side {
                    let visit = self.of_visits[visit as usize].clone();
                    of_side.chi2.clear();
                    let said = say(&self.vantages[visit.clone()], &weights[visit.clone()], middle, &mut of_side.chi2)?;
                    of_side.add_said(&said);
                    sum.chi2[visit].copy_from_slice(&of_side.chi2);
                }
                Some(of_side.said())
            })?;
            sum.add_said(&said);
            sum.middles.push(middle);
        }
        Some(())
    }

    /// What each side shows, by the direction in which its first vote sees it.
    fn shown(&self, middles: Vec<Middle>) -> Vec<Shown> {
        let first = |side: &Vec<u32>| self.of_visits[side[0] as usize].start;
        let directions = self.sides.iter().map(|side| self.model.scene.ray(self.votes[first(side)]).direction);
        directions.zip(middles).collect()
    }
}

/// From where some votes are cast.
fn vantages_of(model: &Model<'_>, votes: &[u32]) -> Vec<Vantage> {
    votes.iter().map(|&ray| Vantage::of(model.scene, model.noise, ray)).collect()
}

/// What the votes of one visit say of a point; their squared residuals are added to `chi2`.
fn say(visit: &[Vantage], weights: &[f64], point: &Vector3<f64>, chi2: &mut Vec<f64>) -> Option<Said> {
    let first = chi2.len();
    let mut said = if let [vantage] = visit {
        let look = vantage.look(0, point)?.by_itself();
        let OneLook { information, gradient, square, log_determinant, left } = OneLook::of(&look, weights[0])?;
        chi2.push(left.norm_squared() / look.variance);
        Said { information, gradient, energy: square + log_determinant }
    } else {
        let looks = looks_by_themselves(visit, point)?;
        let drive = Drive::along(&looks, weights, 1)?;
        chi2.extend(looks.iter().zip(drive.left()).map(|(look, left)| left.norm_squared() / look.variance));
        Said::of(&drive)
    };
    for (&chi2, &weight) in chi2[first..].iter().zip(weights) {
        // Huber's loss is 2 c |r| - c² beyond c, of which the weighted square is c |r|.
        if weight < 1.0 {
            said.energy += (HUBER_SIGMAS * chi2.sqrt() - HUBER_SIGMAS * HUBER_SIGMAS).max(0.0);
        }
    }
    Some(said)
}

/// Equation (1) of the votes of one visit, with the weights that their residuals there have.
pub(crate) fn weighted_terms_of_visit(model: &Model<'_>, visit: &[u32], point: &Vector3<f64>) -> Option<Terms> {
    let vantages = vantages_of(model, visit);
    let (mut weights, mut chi2) = (vec![1.0; visit.len()], Vec::with_capacity(visit.len()));
    let mut said = say(&vantages, &weights, point, &mut chi2)?;
    if weights_of(&chi2, &mut weights) {
        chi2.clear();
        said = say(&vantages, &weights, point, &mut chi2)?;
    }
    let Said { information, gradient, energy } = said;
    Some(Terms { information, gradient, energy, chi2, ..Terms::none() })
}

/// What the heights of its class say of an object with some votes at a point, with a variance of the cameras' heights, m²; and what is up. Nothing before
/// heights are learned.
pub(crate) fn height_terms(
    model: &Model<'_>,
    votes: &[u32],
    point: &Vector3<f64>,
    variance_m2: f64,
) -> Option<(Vector3<f64>, HeightTerms)> {
    let heights = model.class_of_votes(votes)?.heights?;
    let height_m = height_m(model.scene, model.up, votes, point)?;
    Some((model.up?, heights.terms_at(height_m, variance_m2)))
}

/// Variance of the mean position of the cameras of some votes, each axis, m²: heights are above where the cameras are said to be.
pub(crate) fn camera_m2(model: &Model<'_>, votes: &[u32]) -> f64 {
    let (mut sum, mut visits_count) = (0.0, 0.0_f64);
    for visit in visits(model.scene, votes) {
        let view = model.scene.view(visit[0]);
        let (own, shared) = (model.noise.of_image(view).position_m, model.noise.shared(view).position_m);
        sum += shared * shared + own * own / visit.len() as f64;
        visits_count += 1.0;
    }
    sum / (visits_count * visits_count)
}

/// What looks from directions that differ by less than 30 degrees looks from one side (cosine). What is within 15 degrees of one direction, as a sector of
/// looks is (`SECTOR_COSINE`), differs by no more.
pub(crate) const ONE_SIDE_COSINE: f64 = 0.866;

/// Rays in groups that look from one side each: from directions with no less than a cosine to the first of the group.
pub(crate) fn by_side(looks: impl Iterator<Item = (u32, Vector3<f64>)>, least_cosine: f64) -> Vec<Vec<u32>> {
    let mut sides: Vec<(Vector3<f64>, Vec<u32>)> = Vec::new();
    for (ray, direction) in looks {
        match sides.iter_mut().find(|(first, _)| first.dot(&direction) >= least_cosine) {
            Some((_, side)) => side.push(ray),
            None => sides.push((direction, vec![ray])),
        }
    }
    sides.into_iter().map(|(_, side)| side).collect()
}

/// A move that lowers J by less is not committed: less is rounding.
pub(crate) const LEAST_GAIN_OF_MOVE: f64 = 1e-6;

/// The owner of a ray that no object has.
pub(crate) const NOBODY: u32 = u32::MAX;

/// Which of some objects each ray of a scene votes for, or [`NOBODY`].
pub(crate) fn owners<'o>(scene: &Scene, objects: impl IntoIterator<Item = &'o Object>) -> Vec<u32> {
    let mut owner = vec![NOBODY; scene.rays.rays.len()];
    for (i, object) in (0..).zip(objects) {
        object.votes.iter().for_each(|&ray| owner[ray as usize] = i);
    }
    owner
}

/// Which rays of a scene vote for one of some objects.
pub(crate) fn are_taken(scene: &Scene, objects: &[Object]) -> Vec<bool> {
    let mut is_taken = vec![false; scene.rays.rays.len()];
    objects.iter().flat_map(|object| &object.votes).for_each(|&ray| is_taken[ray as usize] = true);
    is_taken
}

/// Logarithm of the physical size that a ray's box implies at a point, m.
#[inline]
#[must_use]
pub fn implied_size(model: &Model<'_>, ray: u32, point: &Vector3<f64>) -> f64 {
    model.ln_angle[ray as usize] + model.scene.ray(ray).project(point).z.ln()
}

/// The size of an object: the median of what its votes imply, drawn to what its class is like where votes are few.
#[must_use]
pub fn size_of(model: &Model<'_>, votes: &[u32], point: &Vector3<f64>) -> f64 {
    usual_size(model, votes, votes.iter().map(|&ray| implied_size(model, ray, point)))
}

/// The same from what each of its votes implies.
pub(crate) fn usual_size(model: &Model<'_>, votes: &[u32], implied: impl Iterator<Item = f64>) -> f64 {
    let mut sizes: Vec<f64> = Vec::with_capacity(votes.len());
    sizes.extend(implied.filter(|size| size.is_finite()));
    let Some(median) = median(&mut sizes) else { return f64::NAN };
    let Some(class) = model.class_of_votes(votes) else { return median };
    let Sizes { object: (mean, sd), spread, .. } = class.sizes;
    if mean.is_nan() {
        return median;
    }
    let of_votes = sizes.len() as f64 / (spread * spread);
    let of_class = 1.0 / (sd * sd);
    (median * of_votes + mean * of_class) / (of_votes + of_class)
}

/// An object with some votes (ascending), and what it is worth.
///
/// Nothing if it has no position.
#[must_use]
pub fn object(model: &Model<'_>, lookout: &Lookout, votes: Vec<u32>, start: Vector3<f64>) -> Option<Object> {
    unseen(model, votes, start)?.with_looks(model, lookout)
}

/// An object with those of some votes (ascending) that fit it, all together; nothing if too few do.
#[must_use]
pub fn fitting(model: &Model<'_>, lookout: &Lookout, votes: Vec<u32>, start: Vector3<f64>) -> Option<Object> {
    fitting_unseen(model, votes, start)?.with_looks(model, lookout)
}

/// The same before it is asked who should have seen it.
#[must_use]
pub fn fitting_unseen(model: &Model<'_>, votes: Vec<u32>, start: Vector3<f64>) -> Option<Object> {
    let limit = model.settings.gate_chi2();
    let found = unseen(model, votes, start)?;
    if found.fit.chi2.iter().all(|chi2| *chi2 <= limit) {
        return Some(found);
    }
    let fits = found.votes.iter().zip(&found.fit.chi2).filter(|(_, chi2)| **chi2 <= limit);
    let left: Vec<u32> = fits.map(|(&ray, _)| ray).collect();
    if left.len() < model.settings.min_votes {
        return None;
    }
    unseen(model, left, found.fit.point)
}

/// An [`object`] before it is asked who should have seen it: J is not less than its energy.
#[must_use]
pub fn unseen(model: &Model<'_>, votes: Vec<u32>, start: Vector3<f64>) -> Option<Object> {
    let class = model.likeliest_class(&votes)?;
    let fit = fit(model, &votes, start)?;
    let (energy, ln_size) = energy_of_votes(model, class, &votes, &fit);
    Some(Object { class, votes, fit, ln_size, seen: Seen::default(), real: 1.0, energy })
}

/// J of an object but for the looks at it, equations (1) to (4), of which it is not less; and the logarithm of its size, m.
#[must_use]
pub fn energy_of_votes(model: &Model<'_>, of_class: u32, votes: &[u32], fit: &Fit) -> (f64, f64) {
    let class = &model.classes[of_class as usize];
    let ln_size = size_of(model, votes, &fit.point);
    let n = votes.len() as f64;
    let ln_2_pi = (2.0 * PI).ln();
    let clutter: f64 = votes.iter().map(|&ray| model.ln_clutter_per_px2(ray)).sum();
    let sizes: f64 = votes
        .iter()
        .map(|&ray| {
            let depth_m = model.scene.ray(ray).project(&fit.point).z;
            class.sizes.log_ratio(model.ln_angle[ray as usize], depth_m, ln_size)
                + model.ln_range_ratio(ray, depth_m)
                + model.ln_score_ratio(ray)
                + model.confusions.ln_share(of_class, model.scene.class_of(ray))
        })
        .sum();
    let of_size = prior_of_size(&class.sizes, ln_size);
    let births = class.ln_births(model.settings, height_m(model.scene, model.up, votes, &fit.point));
    let energy = fit.energy + 2.0 * n * ln_2_pi - 3.0 * ln_2_pi - 2.0 * births + 2.0 * (clutter - sizes - of_size);
    (energy, ln_size)
}

/// Logarithm of how probable a size is among the objects of a class, beside that of a typical one.
fn prior_of_size(sizes: &Sizes, ln_size: f64) -> f64 {
    let (mean, sd) = sizes.object;
    let away = (ln_size - mean) / sd;
    if sizes.tell() && away.is_finite() { -0.5 * away * away } else { 0.0 }
}

/// Objects by place.
#[must_use]
pub fn by_place(objects: &[Object]) -> ByPlace {
    places::by_place(objects.iter().map(|object| object.fit.point))
}

/// Objects of one place together.
#[must_use]
pub fn places_of_all(objects: &[Object], radius_m: f64) -> Vec<Vec<usize>> {
    places::places(&objects.iter().map(|object| (object.votes.len(), object.fit.point)).collect::<Vec<_>>(), radius_m)
}

impl Object {
    /// Whether an image shows both this and another object.
    #[must_use]
    pub fn is_seen_beside(&self, scene: &Scene, other: &Self) -> bool {
        let image = |ray: &u32| scene.image_of(*ray);
        let images: Vec<u32> = other.votes.iter().map(image).collect();
        self.votes.iter().any(|ray| images.binary_search(&image(ray)).is_ok())
    }

    /// One that was [`unseen`], with the looks at it.
    #[must_use]
    pub fn with_looks(mut self, model: &Model<'_>, lookout: &Lookout) -> Option<Self> {
        if !model.settings.has(Part::Looks) {
            return Some(self);
        }
        let class = &model.classes[self.class as usize];
        self.seen = lookout.looks(model, &self.fit.point, &self.votes);
        let judged = self.seen.judged(&Shares::of(class));
        self.energy -= 2.0 * judged.ln_likelihood();
        self.real = judged.real();
        self.energy.is_finite().then_some(self)
    }

    /// Probability that it exists and is real, if its votes are clutter otherwise.
    #[must_use]
    pub fn existence(&self) -> f64 {
        self.real / (1.0 + (0.5 * self.energy).exp())
    }
}

/// For unit tests of what looks at votes and looks alone: an object somewhere.
#[cfg(test)]
pub(crate) fn anywhere(votes: usize, seen: Seen, energy: f64) -> Object {
    let (chi2, shown) = (vec![1.0; votes], Vec::new());
    let fit = Fit { point: Vector3::zeros(), covariance: Matrix3::identity(), energy: 0.0, chi2, shown };
    Object { class: 0, votes: (0..votes as u32).collect(), fit, ln_size: 0.0, seen, real: 1.0, energy }
}
