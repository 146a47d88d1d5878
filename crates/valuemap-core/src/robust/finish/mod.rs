//! From objects to labels: final positions and covariances, which objects exist, and which are others that were taken for new ones.
//!
//! Objects of one place are estimated together ([`positions`](mod@positions)). Votes that a neighbour might have widen the covariance ([`contest`]).
//! Identity switches are left out ([`switches`]), and so are copies ([`copies`]) and what the car carries ([`carried`]).

pub mod carried;
pub mod contest;
pub mod copies;
pub mod one;
pub mod positions;
pub mod switches;

use crate::robust::energy::agreement::variance_factor;
use crate::robust::energy::estimate::Estimate;
use crate::robust::energy::looks::Lookout;
use crate::robust::energy::{Object, placed};
use crate::robust::learn::existence::existences;
use crate::robust::model::Model;
use crate::robust::noise::Noise;
use crate::robust::parts::Part;
use carried::not_carried;
use copies::not_copies;
use switches::are_others;

/// A label with what speaks for it.
#[derive(Debug, Clone)]
pub struct Finding {
    /// Position and covariance.
    pub estimate: Estimate,
    /// Its class: that of most of its votes, but for confusions.
    pub class: u32,
    /// The rays that vote for it, ascending.
    pub votes: Vec<u32>,
    /// Probability that it exists.
    pub existence: f64,
    /// Images that should have seen it.
    pub expected: u32,
}

/// The labels that some objects make where they are estimated, and some of few votes: those that are no others and exist probably enough, ordered by
/// their lowest vote. With it what the covariances were multiplied by, so that the passes agree. Covariances have a noise of their own.
#[must_use]
pub fn labels(
    model: &Model<'_>,
    of_covariances: &Noise,
    lookout: &Lookout,
    (objects, estimates): (Vec<Object>, Vec<Estimate>),
    few: Vec<Object>,
) -> (Vec<Finding>, f64) {
    let factor = if model.settings.has(Part::Scaling) {
        variance_factor(model.scene, of_covariances, &placed(&objects))
    } else {
        1.0
    };
    let existences = existences(model, &objects, &few);
    let scaled = |estimate: Estimate| Estimate { covariance: estimate.covariance * factor, ..estimate };
    let as_they_are = few.iter().map(|object| Estimate { point: object.fit.point, covariance: object.fit.covariance });
    let estimates: Vec<Estimate> = estimates.into_iter().map(scaled).chain(as_they_are).collect();
    let all: Vec<Object> = objects.into_iter().chain(few).collect();
    let not_copies = not_copies(model, lookout, &all);
    let of_itself = |((existence, object), not_copy)| existence * not_carried(model, object) * not_copy;
    let existences: Vec<f64> = existences.into_iter().zip(&all).zip(not_copies).map(of_itself).collect();
    let are_others = are_others(model, &all.iter().collect::<Vec<_>>(), &estimates);
    let mut findings: Vec<Finding> = all
        .into_iter()
        .zip(estimates)
        .zip(existences)
        .zip(are_others)
        .filter(|((_, existence), is_other)| !is_other && *existence >= model.settings.min_existence)
        .map(|(((object, estimate), existence), _)| {
            let expected = lookout.expected(model.scene, &estimate.point, &object.votes);
            Finding { estimate, class: object.class, existence, expected, votes: object.votes }
        })
        .collect();
    findings.sort_by_key(|finding| finding.votes[0]);
    (findings, factor)
}
