//! A label in the making: a point, the rays that support it, and the side it is seen from.

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;

use super::estimate::{Estimate, estimate, own_chi2};
use super::noise::Noise;
use super::scene::Scene;

/// Good enough while voters are still being gathered, m.
pub const ROUGH_M: f64 = 5e-3;
/// Good enough for good, m.
pub const EXACT_M: f64 = 1e-7;
/// Rounds of leaving out voters, at most.
const MAX_TRIMS: usize = 10;

/// Voters whose directions have a mean at least this long are all on one side of the label.
const ONE_SIDED: f64 = 0.6;
/// Half of the angle of a sector, and the least between the middles of two (cosine of 15 degrees).
pub const SECTOR_COSINE: f64 = 0.966;
/// What is seen from one side is not seen from directions farther than this from their mean (cosine of 80 degrees).
const SIDE_COSINE: f64 = 0.17;

/// A point with its covariance and voters.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// Where it is.
    pub estimate: Estimate,
    /// Mean of the unit directions from it to its voters' cameras: short if it is seen from all around.
    pub side: Vector3<f64>,
    /// The class of its voters.
    pub class: u32,
    /// The rays that support it, one an image, ordered by pass, then by number.
    pub voters: Vec<u32>,
    /// Images (ascending) that say nothing for or against it: a stronger label that has no detection of its own there
    /// explains its voter as well, or another label took what it might have had.
    pub undecided: Vec<u32>,
    /// Directions, with 15 degrees around, from which images look at it in vain: what they have in its gate are other things.
    pub unseen_from: Vec<Vector3<f64>>,
    /// Whether the estimate is as exact as it gets.
    pub is_exact: bool,
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
    tolerance_m: f64,
) -> Option<Label> {
    scene.sort_by_pass(&mut voters);
    let class = scene.rays.class[*voters.first()? as usize];
    let mut found = estimate(scene, noise, &voters, start, tolerance_m)?;
    for _ in 0..MAX_TRIMS {
        let own = own_chi2(scene, noise, &voters, &found.point)?;
        let limit = gate_sigmas * gate_sigmas;
        if own.iter().all(|&chi2| chi2 < limit) {
            break;
        }
        // The worst first: one bad voter makes good ones look bad.
        let worst = own.iter().copied().fold(0.0, f64::max);
        let keep = |chi2: f64| chi2 < limit.max(0.5 * worst);
        voters = voters.iter().zip(&own).filter(|&(_, &chi2)| keep(chi2)).map(|(&ray, _)| ray).collect();
        if voters.len() < 2 {
            return None;
        }
        found = estimate(scene, noise, &voters, found.point, tolerance_m)?;
    }
    let side =
        voters.iter().map(|&ray| direction_to(scene, ray, &found.point)).sum::<Vector3<f64>>() / voters.len() as f64;
    Some(Label {
        estimate: found,
        side,
        class,
        voters,
        undecided: Vec::new(),
        unseen_from: Vec::new(),
        is_exact: tolerance_m <= EXACT_M,
    })
}

/// Unit direction from a point to the camera of a ray.
#[must_use]
pub fn direction_to(scene: &Scene, ray: u32, point: &Vector3<f64>) -> Vector3<f64> {
    (scene.ray(ray).center - point).normalize()
}

/// Labels by place.
#[must_use]
pub fn by_place(labels: &[Label]) -> RTree<GeomWithData<[f64; 3], usize>> {
    RTree::bulk_load(labels.iter().enumerate().map(|(i, l)| GeomWithData::new(l.estimate.point.into(), i)).collect())
}

impl Label {
    /// The images of its voters, ascending.
    #[must_use]
    pub fn images(&self, scene: &Scene) -> Vec<u32> {
        let mut images: Vec<u32> = self.voters.iter().map(|&ray| scene.rays.image[ray as usize]).collect();
        images.sort_unstable();
        images
    }

    /// Whether a ray's camera is on the side that the label is seen from.
    #[must_use]
    pub fn faces(&self, scene: &Scene, ray: u32) -> bool {
        let length = self.side.norm();
        let direction = direction_to(scene, ray, &self.estimate.point);
        let is_in_vain = self.unseen_from.iter().any(|unseen| unseen.dot(&direction) > SECTOR_COSINE);
        !is_in_vain && (length < ONE_SIDED || direction.dot(&self.side) / length > SIDE_COSINE)
    }
}
