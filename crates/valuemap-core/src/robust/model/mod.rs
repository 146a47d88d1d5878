//! What the terms of J are made of: the scene, its noise, and what is learned about each class.
//!
//! All rates are densities, so that nothing here has a scale: clutter in detections per image and steradian, births in objects per cubic metre, or per
//! square metre of ground where heights are known.

pub mod aspect;
pub mod confusions;
pub mod existing;
pub mod heights;
pub mod prior;
pub mod ranges;
pub mod steps;

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::Vector3;

use crate::ray::Ray;
use crate::robust::noise::{Noise, Spread, spreads_of};
use crate::robust::parts::Part;
use crate::robust::scene::Scene;
use crate::robust::settings::Settings;
use aspect::Aspect;
use confusions::Confusions;
use existing::Existing;
use heights::{Heights, up_of};
use prior::Prior;
use ranges::{Measured, measured, range_terms};
use steps::{BINS, Steps};

/// Objects of one vote, of two, and of more that rays alone do not tell.
pub const FEW: usize = 3;
/// What is said of an object is said of another thing in this share of the cases: a box is half hidden or merged with another, a range is that of what
/// is behind it, what stands as high as no other stands on a bridge. It bounds what one of them can say. 5 % as in robust regression (Huber and Ronchetti,
/// "Robust Statistics", 2009, section 1).
pub const ODD: f64 = 0.05;
/// What is off by fewer of its standard deviations is chance: one in twenty is off by more.
pub(crate) const CHANCE_SIGMAS: f64 = 2.0;
/// Ratios of densities are no larger than e to this, which stays finite.
const MOST_LN_RATIO: f64 = 30.0;

/// How much more probable, in logarithms, a number is of an object than of clutter, if it may be [`ODD`]: it lies so many standard deviations from what
/// each of the two has, of which that of clutter is so many `times` that of the object.
#[inline]
fn bounded_ln_ratio(times: f64, at_object: f64, as_clutter: f64) -> f64 {
    let ratio = times * (0.5 * (as_clutter * as_clutter - at_object * at_object)).min(MOST_LN_RATIO).exp();
    ((1.0 - ODD) * ratio + ODD).ln()
}

/// What is learned about the objects and the clutter of one class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClassModel {
    /// Whether enough objects told.
    pub is_learned: bool,
    /// How often objects are detected.
    pub rates: Rates,
    /// Objects are detected up to this distance, m.
    pub farthest_m: f64,
    /// The share of the passes in which an object is seen in any share of the looks, or none: hidden, or from where it is not detected.
    pub odd_passes: f64,
    /// The share of what is born that is a ghost: rays that meet by chance, again and again where many boxes are far off.
    pub ghost_share: f64,
    /// Logarithm of the clutter: detections per image and steradian that show no object.
    pub ln_clutter_per_sr: f64,
    /// Logarithm of the density of objects on the ground, 1/m², where heights are known.
    pub ln_births_per_m2: f64,
    /// How high objects are; nothing before anything is learned.
    pub heights: Option<Heights>,
    /// How much denser clutter is at some sines of elevation, in logarithms.
    pub clutter_by_elevation: Steps,
    /// How much more probable votes have a score than clutter has, in logarithms.
    pub score_ratio: Steps,
    /// Detections that miss an object which has no vote in an image, per squared sigma, by sigmas.
    pub tails: Steps,
    /// The share of the looks from some distance, m, that are hits, of that where it is largest.
    pub reach: Steps,
    /// The same of the looks from some angle to the nearest vote.
    pub aspect: Aspect,
    /// What is added to the logarithm of the odds of objects of one vote, of two, and of more that rays alone do not tell: what the numbers of others allow.
    pub ln_odds_of_few: [f64; FEW],
    /// How much denser objects are near others, in logarithms, by minus the distance to the nearest one, m.
    pub company: Steps,
    /// What tells beside the looks at an object whether it exists.
    pub existing: Existing,
    /// How large detections are.
    pub sizes: Sizes,
    /// Mean and standard deviation of the measured ranges of all detections, as depths, ln m.
    pub ranges: (f64, f64),
}

impl ClassModel {
    /// Before anything is learned: all detections of a class may be clutter; `angle` is mean and standard deviation of the angles of its boxes, ln rad,
    /// `ranges` of what is measured of their depths, ln m.
    pub(crate) fn guess(
        scene: &Scene,
        settings: &Settings,
        detections: usize,
        angle: (f64, f64),
        ranges: (f64, f64),
    ) -> Self {
        Self {
            is_learned: false,
            rates: Rates::GUESS,
            farthest_m: settings.viability.max_range_m,
            odd_passes: ODD_PASSES.1,
            ghost_share: 0.0,
            ln_clutter_per_sr: (detections.max(1) as f64 / scene.solid_angle_sr()).ln(),
            ln_births_per_m2: f64::NAN,
            clutter_by_elevation: Steps::NONE,
            score_ratio: Steps::NONE,
            tails: Steps::NONE,
            reach: Steps::ONE,
            aspect: Aspect::ONE,
            ln_odds_of_few: [0.0; FEW],
            company: Steps::NONE,
            existing: Existing::UNTOLD,
            heights: None,
            sizes: Sizes::guess(angle),
            ranges,
        }
    }

    /// The names that its numbers are stored under, in the order of [`to_row`](Self::to_row), each with how many there are. What is a function of
    /// something is stored as the edges between which it is constant, and its values.
    pub const FIELDS: [(&'static str, usize); 37] = [
        ("is_learned", 1),
        ("recall", 1),
        ("recall_concentration_looks", 1),
        ("recall_between_sides_logit", 1),
        ("farthest_m", 1),
        ("odd_passes", 1),
        ("ghost_share", 1),
        ("ln_clutter_per_sr", 1),
        ("ln_births_per_m2", 1),
        ("box_angle_mean_ln_rad", 1),
        ("box_angle_sigma_ln_rad", 1),
        ("object_size_mean_ln_m", 1),
        ("object_size_sigma_ln_m", 1),
        ("size_in_one_box_sigma_ln", 1),
        ("ln_odds_of_one_two_more_votes", FEW),
        ("range_mean_ln_m", 1),
        ("range_sigma_ln_m", 1),
        ("heights_share_mean_m_sigma_m", Heights::NUMBERS - 1),
        ("ln_elsewhere_per_m", 1),
        ("clutter_edges_sine_of_elevation", BINS - 1),
        ("clutter_ln_ratio", BINS),
        ("score_edges", BINS - 1),
        ("score_ln_ratio", BINS),
        ("tails_edges_sigmas", BINS - 1),
        ("tails_per_squared_sigma", BINS),
        ("reach_edges_m", BINS - 1),
        ("reach_share", BINS),
        ("company_edges_minus_m", BINS - 1),
        ("company_ln_ratio", BINS),
        ("aspect_share", Aspect::NUMBERS),
        ("existence_score_edges", BINS - 1),
        ("existence_score_ln_odds", BINS),
        ("existence_nearness_edges", BINS - 1),
        ("existence_nearness_ln_odds", BINS),
        ("existence_approach_edges", BINS - 1),
        ("existence_approach_ln_odds", BINS),
        ("existence_ln_odds", 1),
    ];

    /// How many numbers it is stored as.
    pub const NUMBERS: usize = {
        let (mut sum, mut field) = (0, 0);
        while field < Self::FIELDS.len() {
            sum += Self::FIELDS[field].1;
            field += 1;
        }
        sum
    };

    /// All of it as numbers, for storage.
    #[must_use]
    pub fn to_row(&self) -> Vec<f64> {
        let heights = self.heights.map_or([f64::NAN; Heights::NUMBERS], |heights| heights.to_row());
        let numbers = [
            f64::from(u8::from(self.is_learned)),
            self.rates.recall,
            self.rates.concentration,
            self.rates.between,
            self.farthest_m,
            self.odd_passes,
            self.ghost_share,
            self.ln_clutter_per_sr,
            self.ln_births_per_m2,
            self.sizes.angle.0,
            self.sizes.angle.1,
            self.sizes.object.0,
            self.sizes.object.1,
            self.sizes.spread,
            self.ln_odds_of_few[0],
            self.ln_odds_of_few[1],
            self.ln_odds_of_few[2],
            self.ranges.0,
            self.ranges.1,
        ];
        let steps = [self.clutter_by_elevation, self.score_ratio, self.tails, self.reach, self.company];
        let steps = steps.map(|steps| steps.to_row());
        let told = self.aspect.to_row().into_iter().chain(self.existing.to_row());
        numbers.into_iter().chain(heights).chain(steps.into_iter().flatten()).chain(told).collect()
    }

    /// What `to_row` returned; nothing of another number of numbers.
    #[must_use]
    pub fn from_row(row: &[f64]) -> Option<Self> {
        let (numbers, rest) = row.split_first_chunk::<19>()?;
        let (heights, rest) = rest.split_first_chunk::<{ Heights::NUMBERS }>()?;
        let (clutter, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (scores, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (tails, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (reach, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (company, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (aspect, rest) = rest.split_first_chunk::<{ Aspect::NUMBERS }>()?;
        let existing = Existing::from_row(rest.try_into().ok()?)?;
        let &[
            is_learned,
            recall,
            concentration,
            between,
            farthest_m,
            odd_passes,
            ghost_share,
            ln_clutter_per_sr,
            ln_births_per_m2,
            angle_mean,
            angle_sd,
            object_mean,
            object_sd,
            spread,
            ln_odds_of_one,
            ln_odds_of_two,
            ln_odds_of_more,
            range_mean,
            range_sd,
        ] = numbers;
        Some(Self {
            is_learned: is_learned > 0.0,
            rates: Rates { recall, concentration, between },
            farthest_m,
            odd_passes,
            ghost_share,
            ln_clutter_per_sr,
            ln_births_per_m2,
            heights: Heights::from_row(heights),
            clutter_by_elevation: Steps::from_row(clutter),
            score_ratio: Steps::from_row(scores),
            tails: Steps::from_row(tails),
            reach: Steps::from_row(reach),
            aspect: Aspect::from_row(aspect),
            ln_odds_of_few: [ln_odds_of_one, ln_odds_of_two, ln_odds_of_more],
            company: Steps::from_row(company),
            sizes: Sizes { angle: (angle_mean, angle_sd), object: (object_mean, object_sd), spread },
            existing,
            ranges: (range_mean, range_sd),
        })
    }

    /// Like this, but with the clutter of another class, the angles of its boxes and its ranges; that itself if nothing is learned.
    #[must_use]
    pub fn with_own(&self, own: &Self) -> Self {
        if !self.is_learned {
            return *own;
        }
        Self {
            ln_clutter_per_sr: own.ln_clutter_per_sr,
            sizes: Sizes { spread: self.sizes.spread, ..own.sizes },
            heights: None,
            ranges: own.ranges,
            company: Steps::NONE,
            is_learned: false,
            ..*self
        }
    }

    /// Logarithm of the density of objects at a height above the cameras, m, 1/m³.
    #[must_use]
    pub fn ln_births(&self, settings: &Settings, height_m: Option<f64>) -> f64 {
        match (&self.heights, height_m) {
            (Some(heights), Some(height_m)) => self.ln_births_per_m2 + heights.ln_density(height_m),
            _ => settings.ln_births_per_m3(),
        }
    }
}

/// How often an object is detected: a share of the looks that differs from object to object and from side to side, a logit-normal distribution,
/// and around that from pass to pass, a beta distribution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Its mean.
    pub recall: f64,
    /// How little it differs between the passes of one side: the sum of both parameters of the beta distribution, in looks.
    pub concentration: f64,
    /// Standard deviation of the logit of the share between sides.
    pub between: f64,
}

/// Logarithms of box sizes as angles, and of physical sizes in metres: angle times depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sizes {
    /// Mean and standard deviation of the angles of all boxes, ln rad.
    pub angle: (f64, f64),
    /// Mean and standard deviation of the physical sizes of objects, ln m.
    pub object: (f64, f64),
    /// Standard deviation of the size that one detection implies around that of its object.
    pub spread: f64,
}

/// Detections this many times farther than `max_range_m` still vote. Some objects are seen from beyond `max_range_m` alone; without any bound a position
/// without parallax may run to infinity.
pub const VOTE_RANGE: f64 = 2.5;
/// Sizes that say nothing: boxes of one size in all pictures, or no boxes. What boxes of one object differ by is far more.
const LEAST_ANGLE_SD: f64 = 1e-3;

impl Sizes {
    /// Before anything is learned: objects of one class differ by a factor of two, and boxes of one object by a third.
    #[must_use]
    pub fn guess(angle: (f64, f64)) -> Self {
        Self { angle, object: (f64::NAN, 0.7), spread: 0.3 }
    }

    /// Whether sizes tell anything at all.
    #[must_use]
    pub fn tell(&self) -> bool {
        self.angle.1 > LEAST_ANGLE_SD && self.spread < self.angle.1
    }

    /// How much more probable, in logarithms, a box is at an object of a size than as clutter; `angle` and `size` are logarithms.
    #[inline]
    #[must_use]
    pub fn log_ratio(&self, angle: f64, depth_m: f64, size: f64) -> f64 {
        if !self.tell() || !angle.is_finite() || !size.is_finite() {
            return 0.0;
        }
        let at_object = (angle + depth_m.ln() - size) / self.spread;
        let as_clutter = (angle - self.angle.0) / self.angle.1;
        bounded_ln_ratio(self.angle.1 / self.spread, at_object, as_clutter)
    }

    /// Whether two implied sizes may be of one object.
    #[inline]
    #[must_use]
    pub fn agree(&self, a: f64, b: f64, gate_sigmas: f64) -> bool {
        !self.tell() || !((a - b).abs() > gate_sigmas * self.spread * std::f64::consts::SQRT_2)
    }
}

/// A scene with everything that a term of J needs.
pub struct Model<'a> {
    /// What was seen.
    pub scene: &'a Scene,
    /// Errors of poses and detections.
    pub noise: &'a Noise,
    /// What is up in the world, if the cameras tell.
    pub up: Option<Vector3<f64>>,
    /// All errors of each ray together.
    pub spreads: Arc<Vec<Spread>>,
    /// Logarithm of the angle that each ray's box spans, rad; not finite where it has no box.
    pub ln_angle: Vec<f64>,
    /// Logarithm of the squared pixels that a unit of each ray's virtual image plane spans.
    ln_scale2: Vec<f64>,
    /// The measured range of each ray; empty where none is measured.
    ranges: Vec<Measured>,
    /// Sine of each ray's elevation; not a number where nobody knows what is up.
    pub sin_elevation: Vec<f64>,
    /// How much denser clutter is at each ray, in logarithms, as objects are missed there; empty where it is not.
    pub ln_tails: Vec<f64>,
    /// How many rays there are that may vote.
    usable: usize,
    /// What is learned, by class.
    pub classes: Vec<ClassModel>,
    /// What is learned of all classes together.
    pub pooled: ClassModel,
    /// Which classes are taken for which.
    pub confusions: Confusions,
    /// Settings of the run.
    pub settings: &'a Settings,
}

impl<'a> Model<'a> {
    /// A model of which nothing is learned yet: all detections may be clutter.
    #[must_use]
    pub fn new(scene: &'a Scene, noise: &'a Noise, settings: &'a Settings) -> Self {
        let usable = scene.usable_rays();
        let spreads = spreads_of(scene, noise);
        let angle = |(&size, &scale2): (&f64, &f64)| {
            if settings.has(Part::Sizes) { (size / scale2.sqrt()).ln() } else { f64::NAN }
        };
        let ln_angle: Vec<f64> = scene.box_px.iter().zip(&scene.scale2).map(angle).collect();
        let ln_scale2 = scene.scale2.iter().map(|scale2| scale2.ln()).collect();
        let ranges = if settings.has(Part::Ranges) { measured(scene) } else { Vec::new() };
        let count = scene.rays.class.iter().max().map_or(0, |&last| last as usize + 1);
        let of = |rays: Vec<usize>| {
            let angles: Vec<f64> = rays.iter().map(|&ray| ln_angle[ray]).filter(|angle| angle.is_finite()).collect();
            let depths: Vec<f64> = rays.iter().filter_map(|&ray| ranges.get(ray)).map(|range| range.ln_depth).collect();
            let depths: Vec<f64> = depths.into_iter().filter(|depth| depth.is_finite()).collect();
            ClassModel::guess(scene, settings, rays.len(), mean_and_sd(&angles), mean_and_sd(&depths))
        };
        let all = || usable.iter().map(|&ray| ray as usize);
        let classes =
            (0..count as u32).map(|class| of(all().filter(|&ray| scene.rays.class[ray] == class).collect())).collect();
        let pooled = of(all().collect());
        let up = up_of(scene);
        let sin_elevation = |ray: &Ray| up.map_or(f64::NAN, |up| up.dot(&ray.direction));
        let sin_elevation = scene.rays.rays.iter().map(sin_elevation).collect();
        Self {
            scene,
            noise,
            up,
            spreads: Arc::new(spreads),
            ln_angle,
            ln_scale2,
            ranges,
            sin_elevation,
            ln_tails: Vec::new(),
            usable: usable.len(),
            confusions: Confusions::default(),
            classes,
            pooled,
            settings,
        }
    }

    /// The same with another noise.
    #[must_use]
    pub fn with_noise<'b>(self, noise: &'b Noise) -> Model<'b>
    where
        'a: 'b,
    {
        Model { noise, spreads: Arc::new(spreads_of(self.scene, noise)), ..self }
    }

    /// Take what is known of the classes; those that nothing is known of are like all together, but for their clutter and the angles of their boxes.
    pub fn know(&mut self, classes: &[Option<ClassModel>], pooled: ClassModel, confusions: &Confusions) {
        self.pooled = pooled;
        self.confusions = confusions.clone();
        for (class, own) in self.classes.iter_mut().enumerate() {
            *own = classes.get(class).copied().flatten().unwrap_or_else(|| pooled.with_own(own));
        }
    }

    /// The same with what another model has learned.
    #[must_use]
    pub fn knowing(mut self, other: &Model<'_>) -> Self {
        self.classes.clone_from(&other.classes);
        self.pooled = other.pooled;
        self.confusions = other.confusions.clone();
        self
    }

    /// What the cameras look at where some of the rays were found, sr: as large a part of all.
    #[must_use]
    pub fn solid_angle_sr(&self, rays: usize) -> f64 {
        self.scene.solid_angle_sr() * self.share_of(rays)
    }

    /// The share of the usable rays that so many are.
    #[must_use]
    pub fn share_of(&self, rays: usize) -> f64 {
        rays as f64 / self.usable.max(1) as f64
    }

    /// What is learned about the class of a ray.
    #[inline]
    #[must_use]
    pub fn class_of(&self, ray: u32) -> &ClassModel {
        &self.classes[self.scene.class_of(ray) as usize]
    }

    /// How far from its camera an object may be that a detection votes for, m.
    #[must_use]
    pub fn reach_m(&self) -> f64 {
        self.settings.viability.max_range_m * VOTE_RANGE
    }

    /// The class that an object with some votes most probably is of.
    #[must_use]
    pub fn likeliest_class(&self, votes: &[u32]) -> Option<u32> {
        self.confusions.likeliest(votes.iter().map(|&ray| self.scene.class_of(ray)))
    }

    /// What is learned about it.
    #[must_use]
    pub fn class_of_votes(&self, votes: &[u32]) -> Option<&ClassModel> {
        self.likeliest_class(votes).map(|class| &self.classes[class as usize])
    }

    /// Logarithm of the clutter around a ray, per squared pixel.
    #[inline]
    #[must_use]
    pub fn ln_clutter_per_px2(&self, ray: u32) -> f64 {
        let ln_tails = self.ln_tails.get(ray as usize).copied().unwrap_or(0.0);
        self.class_of(ray).ln_clutter_per_sr + ln_tails - self.ln_scale2[ray as usize]
    }

    /// How much more probable, in logarithms, a vote has the score of a ray than clutter has.
    #[inline]
    #[must_use]
    pub fn ln_score_ratio(&self, ray: u32) -> f64 {
        self.class_of(ray).score_ratio.at(self.scene.score[ray as usize])
    }

    /// How much more probable, in logarithms, the measured range of a ray is of an object at a depth than of clutter; 0 where none is measured.
    #[inline]
    #[must_use]
    pub fn ln_range_ratio(&self, ray: u32, depth_m: f64) -> f64 {
        let range = self.ranges.get(ray as usize);
        range.map_or(0.0, |range| range.log_ratio(depth_m, self.class_of(ray).ranges))
    }

    /// Whether the range of a ray is measured.
    #[must_use]
    pub fn has_range(&self, ray: u32) -> bool {
        self.ranges.get(ray as usize).is_some_and(Measured::is_there)
    }

    /// What the measured range of a ray says of a point; nothing where none is measured.
    #[must_use]
    pub fn range_terms(&self, ray: u32, point: &Vector3<f64>) -> Option<Prior> {
        let (scene, row) = (self.scene, ray as usize);
        let told = || range_terms([scene.range_m[row], scene.range_sigma_m[row]], &scene.ray(ray).center, point);
        self.has_range(ray).then(told)?
    }

    /// Whether a ray may be more probable as a vote for a point than as clutter. Not where the camera is so near that, for all that is known of its
    /// position, the object might be anywhere in the picture, or behind it.
    #[inline]
    #[must_use]
    pub fn may_tell(&self, ray: u32, point: &Vector3<f64>) -> bool {
        let variance_px2 = self.spreads[ray as usize].variance(self.scene.ray(ray).project(point).z);
        (2.0 * PI * variance_px2).ln() + self.ln_clutter_per_px2(ray) < 0.0
    }

    /// What votes for objects of a class are worth.
    #[inline]
    #[must_use]
    pub fn votes_for(&self, class: u32) -> VotesFor<'_> {
        let learned = &self.classes[class as usize];
        VotesFor { model: self, class, learned, log_odds: learned.rates.log_odds() }
    }
}

/// What votes for objects of a class are worth.
pub struct VotesFor<'a> {
    model: &'a Model<'a>,
    class: u32,
    learned: &'a ClassModel,
    log_odds: f64,
}

impl VotesFor<'_> {
    /// How much more probable, in logarithms, a detection is as a vote than as clutter, if its object, of size `ln_size`, is where the residual has a
    /// squared length of `chi2` sigmas with a covariance of determinant `px4`.
    #[inline]
    #[must_use]
    pub fn gain(&self, ray: u32, chi2: f64, px4: f64, depth_m: f64, ln_size: f64) -> f64 {
        let Self { model, class, learned, log_odds } = *self;
        -0.5 * (chi2 + px4.ln()) - (2.0 * PI).ln() - model.ln_clutter_per_px2(ray)
            + learned.sizes.log_ratio(model.ln_angle[ray as usize], depth_m, ln_size)
            + model.ln_range_ratio(ray, depth_m)
            + model.ln_score_ratio(ray)
            + model.confusions.ln_share(class, model.scene.class_of(ray))
            + log_odds
    }
}

/// The share of false things among what is born and no ghost. It is not learned: of two passes, a real object that one of them missed and a thing that
/// the other did not meet look the same, and whatever is thought of them confirms itself. Larger: objects that one of few passes missed are lost; smaller: what
/// one of few passes alone met is taken for real.
pub const FALSE_SHARE: f64 = 0.1;

/// Standard deviation of the share of hits between sides, at least. The shares that are compared are a twelfth apart: with less, a mean between two of them
/// would be far from both.
const LEAST_BETWEEN: f64 = 0.05;

/// The share of odd passes: at least, before anything is learned, at most. More than a half would not be odd.
pub const ODD_PASSES: (f64, f64, f64) = (ODD, 0.2, 0.5);

impl Rates {
    /// Of things of which nothing is known (Jeffreys).
    pub const ANY: Self = Self { recall: 0.5, concentration: 1.0, between: 0.0 };
    /// Before anything is learned. It claims little: of such a beta distribution any share may be, large ones rather than small ones.
    pub const GUESS: Self = Self { recall: 0.7, concentration: 3.0, between: 0.0 };
    /// Of objects of which each is seen in the same share of the looks: as many tell a tenth from none.
    pub const ALIKE: Self = Self { concentration: 100.0, ..Self::GUESS };

    /// How probable it is that a side has a share of hits, but for a factor: the logit is normal.
    #[must_use]
    pub fn density(&self, share: f64) -> f64 {
        let logit = |p: f64| (p / (1.0 - p)).ln();
        // No narrower than shares are told apart.
        let sigma = self.between.max(LEAST_BETWEEN / (self.recall * (1.0 - self.recall)));
        let away = (logit(share) - logit(self.recall)) / sigma;
        (-0.5 * away * away).exp() / (share * (1.0 - share))
    }

    /// What one more hit instead of a miss is worth, about.
    #[must_use]
    pub fn log_odds(&self) -> f64 {
        (self.recall / (1.0 - self.recall)).ln()
    }

    /// What a miss costs, about.
    #[must_use]
    pub fn log_miss(&self) -> f64 {
        (1.0 - self.recall).ln()
    }

    /// Logarithm of the likelihood of `hits` among some looks of a pass, in one order: beta-binomial.
    #[must_use]
    pub fn log_likelihood(&self, hits: f64, looks: f64) -> f64 {
        let (a, b) = (self.recall * self.concentration, (1.0 - self.recall) * self.concentration);
        log_rising(a, hits) + log_rising(b, looks - hits) - log_rising(a + b, looks)
    }
}

/// `ln(Gamma(x + n) / Gamma(x))`: `log(x (x + 1) ... (x + n - 1))` for whole n.
fn log_rising(x: f64, n: f64) -> f64 {
    if n <= 0.0 { 0.0 } else { ln_gamma(x + n) - ln_gamma(x) }
}

/// Logarithm of the gamma function of a positive number: Stirling's series (Abramowitz and Stegun, 6.1.41) beyond 8.
pub(crate) fn ln_gamma(mut x: f64) -> f64 {
    let mut product = 1.0;
    while x < 8.0 {
        product *= x;
        x += 1.0;
    }
    let inverse = 1.0 / x;
    let square = inverse * inverse;
    let series = inverse * (1.0 / 12.0 - square * (1.0 / 360.0 - square * (1.0 / 1260.0)));
    (x - 0.5) * x.ln() - x + 0.5 * (2.0 * PI).ln() + series - product.ln()
}

/// The median of some numbers, which are put into another order; of an even number of them the larger of the two in the middle. Nothing of nothing.
pub(crate) fn median(numbers: &mut [f64]) -> Option<f64> {
    let middle = numbers.len() / 2;
    (!numbers.is_empty()).then(|| *numbers.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Mean and standard deviation; 0 of nothing.
#[must_use]
pub fn mean_and_sd(values: &[f64]) -> (f64, f64) {
    let count = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|value| (value - mean) * (value - mean)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_stored_under_their_names() {
        let steps = |first: f64| Steps::even(first, std::array::from_fn(|bin| first + bin as f64));
        let heights = Heights::learn(&[3.0; 30], &[0.1; 30], 50.0);
        let model = ClassModel {
            is_learned: true,
            rates: Rates { recall: 0.61, concentration: 7.0, between: 0.4 },
            farthest_m: 61.0,
            odd_passes: 0.02,
            ghost_share: 0.3,
            ln_clutter_per_sr: -1.0,
            ln_births_per_m2: -6.0,
            heights,
            clutter_by_elevation: steps(100.0),
            score_ratio: steps(200.0),
            tails: steps(300.0),
            reach: steps(400.0),
            aspect: Aspect::ONE,
            ln_odds_of_few: [-3.0, -2.0, 0.5],
            company: steps(500.0),
            existing: Existing {
                by_score: steps(600.0),
                by_nearness: steps(700.0),
                by_approach: steps(800.0),
                ln_odds: 0.25,
            },
            sizes: Sizes { angle: (-4.0, 0.7), object: (-0.5, 0.2), spread: 0.1 },
            ranges: (2.5, 0.6),
        };
        let row = model.to_row();
        assert_eq!(row.len(), ClassModel::NUMBERS);
        let stored = |name: &str| -> &[f64] {
            let before = ClassModel::FIELDS.iter().take_while(|field| field.0 != name);
            let first = before.map(|field| field.1).sum::<usize>();
            let count = ClassModel::FIELDS.iter().find(|field| field.0 == name).map_or(0, |field| field.1);
            &row[first..first + count]
        };
        for (name, numbers) in [
            ("is_learned", vec![1.0]),
            ("recall", vec![0.61]),
            ("recall_concentration_looks", vec![7.0]),
            ("recall_between_sides_logit", vec![0.4]),
            ("farthest_m", vec![61.0]),
            ("odd_passes", vec![0.02]),
            ("ghost_share", vec![0.3]),
            ("ln_clutter_per_sr", vec![-1.0]),
            ("ln_births_per_m2", vec![-6.0]),
            ("box_angle_mean_ln_rad", vec![-4.0]),
            ("box_angle_sigma_ln_rad", vec![0.7]),
            ("object_size_mean_ln_m", vec![-0.5]),
            ("object_size_sigma_ln_m", vec![0.2]),
            ("size_in_one_box_sigma_ln", vec![0.1]),
            ("ln_odds_of_one_two_more_votes", vec![-3.0, -2.0, 0.5]),
            ("range_mean_ln_m", vec![2.5]),
            ("range_sigma_ln_m", vec![0.6]),
            ("ln_elsewhere_per_m", heights.iter().filter_map(|heights| heights.to_row().last().copied()).collect()),
            ("existence_ln_odds", vec![0.25]),
            ("aspect_share", vec![1.0; Aspect::NUMBERS]),
        ] {
            assert_eq!(stored(name), numbers, "{name}");
        }
        // The first component of heights has the mean second.
        assert!((stored("heights_share_mean_m_sigma_m")[1] - 3.0).abs() < 0.1);
        for (edges, values, first) in [
            ("clutter_edges_sine_of_elevation", "clutter_ln_ratio", 100.0),
            ("score_edges", "score_ln_ratio", 200.0),
            ("tails_edges_sigmas", "tails_per_squared_sigma", 300.0),
            ("reach_edges_m", "reach_share", 400.0),
            ("company_edges_minus_m", "company_ln_ratio", 500.0),
            ("existence_score_edges", "existence_score_ln_odds", 600.0),
            ("existence_nearness_edges", "existence_nearness_ln_odds", 700.0),
            ("existence_approach_edges", "existence_approach_ln_odds", 800.0),
        ] {
            assert!((stored(edges)[0] - first / BINS as f64).abs() < 1e-9, "{edges}");
            assert!((stored(values)[0] - first).abs() < 1e-9, "{values}");
        }
    }

    #[test]
    fn the_beta_binomial_is_that_of_whole_numbers() {
        let rates = Rates { recall: 0.6, concentration: 4.0, between: 0.0 };
        // B(2.4 + 2, 1.6 + 1) / B(2.4, 1.6) = (2.4 * 3.4 * 1.6) / (4 * 5 * 6).
        let expected = (2.4_f64 * 3.4 * 1.6 / (4.0 * 5.0 * 6.0)).ln();
        assert!((rates.log_likelihood(2.0, 3.0) - expected).abs() < 1e-9);
        assert!(rates.log_likelihood(0.0, 0.0).abs() < 1e-12);
    }

    #[test]
    fn a_size_that_disagrees_says_no_more_than_that_sizes_are_odd_at_times() {
        let sizes = Sizes { angle: (-3.0, 0.8), object: (0.0, 0.5), spread: 0.1 };
        assert!(sizes.log_ratio(-3.0, 3.0_f64.exp(), 0.0) > 1.5);
        assert!((sizes.log_ratio(-3.0, 5.0_f64.exp(), 0.0) - ODD.ln()).abs() < 1e-6);
    }
}
