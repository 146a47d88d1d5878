//! Exchange: two neighbours may have each other's votes from some directions, and have moved so that these votes fit; then no
//! single vote changes sides. The images that show both say so ([`untangle`](crate::robust::search::untangle)).

use rayon::prelude::*;

use super::label::{Label, from_voters};
use super::pairs::{nearest_pairs, replaced};
use crate::robust::model::Model;
use crate::robust::search::untangle::{reach_m, votes_of_both, which_is_which};

/// Let neighbours exchange votes where their images say so; what only one of them has in an image is given anew. The
/// nearest pairs first, each label in one pair.
#[must_use]
pub fn exchange(model: &Model<'_>, labels: Vec<Label>) -> Vec<Label> {
    let is_open = |a: &Label, b: &Label| a.class == b.class && !a.known.untangled.contains(&b.identity());
    let pairs = nearest_pairs(&labels, reach_m(model), is_open);
    let exchanged = pairs.par_iter().map(|&(a, b)| exchanged(model, [&labels[a], &labels[b]])).collect();
    replaced(labels, &pairs, exchanged, |known, neighbor| known.untangled.push(neighbor))
}

/// The two labels after an exchange; nothing if they are best as they are.
fn exchanged(model: &Model<'_>, of: [&Label; 2]) -> Option<Vec<Label>> {
    let votes = of.map(|label| label.voters.as_slice());
    let exchange =
        which_is_which(model.scene, model.noise, votes, of.map(|label| label.estimate.point), reach_m(model))?;
    let label = |(voters, old): (Vec<u32>, &Label)| {
        from_voters(model.scene, model.noise, model.settings.gate_sigmas, voters, old.estimate.point)
    };
    votes_of_both(&exchange.shown).into_iter().zip(of).map(label).collect()
}
