//! A label of the initial map: a position with its covariance, the rays that vote for it, and the side that it is seen from.

use std::hash::{Hash, Hasher};
use std::sync::OnceLock;

use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHasher;

use crate::robust::energy::estimate::{Care, Elsewhere, Estimate, Joint, Limits, Start};
use crate::robust::energy::places::ByPlace;
use crate::robust::energy::{agreement, places};
use crate::robust::noise::Noise;
use crate::robust::scene::sample::fingerprint;
use crate::robust::scene::{Scene, View};

/// A label that moved by less, squared and in sigmas, is what it was. It is half a sigma, about: with a third more is decided anew, which costs time.
const SMALL_MOVE_CHI2: f64 = 0.3;
/// A label whose mean direction of sight changed by less is seen from where it was. Of voters from one direction it is 6 degrees, less than half of what a
/// sector reaches (`SECTOR_COSINE`).
const SMALL_TURN: f64 = 0.1;
/// So many labels tell about how far their passes disagree. Of two passes each, their mean is known to 4 % (chi² with three degrees of freedom).
const DISAGREEING: usize = 400;

/// Voters whose directions have a mean at least this long are all on one side of the label. Of directions that are spread evenly over half a circle it is 0.64
/// long.
const ONE_SIDED: f64 = 0.6;
/// What is seen from one side is not seen from directions farther than this from their mean (cosine of 80 degrees). A flat face is a sixth as wide from there.
const SIDE_COSINE: f64 = 0.17;

/// A point with its covariance and voters.
#[derive(Debug, Clone)]
pub struct Label {
    /// Where it is.
    pub estimate: Estimate,
    /// Mean of the unit directions from it to its voters' cameras: short if it is seen from all around.
    pub side: Vector3<f64>,
    /// The class of its voters.
    pub class: u32,
    /// The rays that support it, one an image, ordered by pass, then by number.
    pub voters: Vec<u32>,
    /// How much each of them counted when it was last estimated, 0 to 1.
    pub weights: Vec<f64>,
    /// For each visit that votes for it: where all others put it.
    pub elsewhere: Vec<Elsewhere>,
    /// Votes that it was given, and that do not fit once its place is estimated together.
    pub refused: Vec<u32>,
    /// What it was when it last changed.
    pub revision: Revision,
    /// What follows from that.
    pub known: Known,
}

/// What a label was when it last changed: small moves are no change.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Revision {
    /// Fingerprint of its voters.
    pub voters: u64,
    /// Where it was when it last moved.
    pub point: Vector3<f64>,
    /// From where it was seen then, see [`Label::side`].
    pub side: Vector3<f64>,
    /// Fingerprint of the votes of all labels that it was last estimated with.
    pub place: u64,
}

/// What was found out about a label as it is; forgotten when it changes.
#[derive(Debug, Clone, Default)]
pub struct Known {
    /// How far its visits disagree, see [`variance_factor`](crate::robust::energy::agreement::variance_factor).
    pub disagreement: OnceLock<Option<agreement::Disagreement>>,
    /// Whether it was found not to be two.
    pub is_one: bool,
    /// Neighbors, as they were, that it was found to have no votes to exchange with.
    pub untangled: Vec<u64>,
}

/// Estimate from voters in any order, without those that disagree with the others of their pass.
///
/// The gate that gathered them allows for all errors of a pose; but images of one pass are wrong together, so what is
/// left of a residual when the shared error is taken out must fit the image's own errors alone.
#[must_use]
pub fn from_voters(
    scene: &Scene,
    noise: &Noise,
    gate_sigmas: f64,
    mut voters: Vec<u32>,
    start: Vector3<f64>,
) -> Option<Label> {
    voters.sort_unstable();
    let class = scene.rays.class[*voters.first()? as usize];
    let start = Start { voters: &voters, weights: &[], point: start };
    let limits = Limits { gate_sigmas, min_votes: 2 };
    let solution = Joint::new(scene, noise, std::iter::once(start), Care::Rough).solve_within(&limits)?;
    let estimate = solution.estimates[0];
    let voters: Vec<u32> = solution.votes().iter().map(|(_, ray)| *ray).collect();
    (voters.len() >= 2).then(|| Label {
        estimate,
        side: side_of(scene, &voters, &estimate.point),
        class,
        voters,
        weights: solution.weights().to_vec(),
        elsewhere: Vec::new(),
        refused: Vec::new(),
        revision: Revision::default(),
        known: Known::default(),
    })
}

/// Mean of the unit directions from a point to the cameras of its voters.
#[must_use]
pub fn side_of(scene: &Scene, voters: &[u32], point: &Vector3<f64>) -> Vector3<f64> {
    voters.iter().map(|&ray| direction_to(scene, ray, point)).sum::<Vector3<f64>>() / voters.len() as f64
}

/// Unit direction from a point to the camera of a ray.
#[must_use]
pub fn direction_to(scene: &Scene, ray: u32, point: &Vector3<f64>) -> Vector3<f64> {
    (scene.ray(ray).center - point).normalize()
}

/// How much larger than they are said to be the errors are that labels of several passes show, at least 1.
#[must_use]
pub fn variance_factor(scene: &Scene, noise: &Noise, labels: &[Label]) -> f64 {
    let labels: Vec<&Label> = labels.iter().step_by((labels.len() / DISAGREEING).max(1)).collect();
    let of_label = |label: &&Label| {
        let placed = || (label.voters.clone(), label.estimate.point);
        *label.known.disagreement.get_or_init(|| agreement::disagreement(scene, noise, &placed()))
    };
    agreement::mean(labels.par_iter().map(of_label).collect()).unwrap_or(1.0).max(1.0)
}

/// Labels by place.
#[must_use]
pub fn by_place(labels: &[Label]) -> ByPlace {
    places::by_place(labels.iter().map(|label| label.estimate.point))
}

/// The lowest ray of a label: what labels are ordered by.
#[must_use]
pub fn first_voter(label: &Label) -> u32 {
    label.voters.iter().copied().min().unwrap_or(u32::MAX)
}

impl Label {
    /// How many images show it and another one as detections of their own.
    #[must_use]
    pub fn images_shared(&self, other: &Self, scene: &Scene) -> usize {
        let others = other.images(scene);
        self.images(scene).iter().filter(|image| others.binary_search(image).is_ok()).count()
    }

    /// The images of its voters, ascending.
    #[must_use]
    pub fn images(&self, scene: &Scene) -> Vec<u32> {
        let mut images: Vec<u32> = self.voters.iter().map(|&ray| scene.image_of(ray)).collect();
        images.sort_unstable();
        images
    }

    /// A fingerprint of where it is and from where it is seen; small moves change nothing.
    #[must_use]
    pub fn stand(&self) -> u64 {
        let mut hasher = FxHasher::default();
        let is_new = self.revision == Revision::default();
        let [point, side] =
            if is_new { [self.estimate.point, self.side] } else { [self.revision.point, self.revision.side] };
        self.class.hash(&mut hasher);
        point.iter().chain(&side).for_each(|number| number.to_bits().hash(&mut hasher));
        hasher.finish()
    }

    /// A fingerprint of that and its voters.
    #[must_use]
    pub fn identity(&self) -> u64 {
        let mut hasher = FxHasher::default();
        (self.stand(), fingerprint(&self.voters)).hash(&mut hasher);
        hasher.finish()
    }

    /// Note where it was estimated to be, and what it rests on.
    pub fn revise(&mut self) {
        let voters = fingerprint(&self.voters);
        let step = self.estimate.point - self.revision.point;
        let chi2 = self.estimate.covariance.cholesky().map(|cholesky| step.dot(&cholesky.solve(&step)));
        let turn = (self.side - self.revision.side).norm();
        let stays = chi2.is_some_and(|chi2| chi2 < SMALL_MOVE_CHI2) && turn < SMALL_TURN;
        if !stays {
            (self.revision.point, self.revision.side) = (self.estimate.point, self.side);
        }
        if !stays || voters != self.revision.voters {
            self.revision.voters = voters;
            self.known = Known::default();
        }
    }

    /// Where it is, as far as visits other than a view's tell.
    #[must_use]
    pub fn elsewhere(&self, view: &View) -> Estimate {
        self.elsewhere.iter().find(|other| other.leaves_out(view)).map_or(self.estimate, |other| other.estimate)
    }

    /// Whether a ray's camera is on the side that the label is seen from.
    #[must_use]
    pub fn faces(&self, scene: &Scene, ray: u32) -> bool {
        let length = self.side.norm();
        let direction = direction_to(scene, ray, &self.estimate.point);
        length < ONE_SIDED || direction.dot(&self.side) / length > SIDE_COSINE
    }
}
