//! Detection rate by distance: the share of the looks at a class that are hits, over that where it is largest.
//!
//! It weighs looks from afar in equation (5) of `docs/method.md`, where a miss says less.

use super::rates::LEAST_LOOKS;
use crate::robust::energy::Object;
use crate::robust::energy::looks::Lookout;
use crate::robust::model::Model;
use crate::robust::model::steps::{BINS, Steps, bin};

/// Objects that tell, at most: a share of some thousand looks is known to 1 %.
const MOST_OBJECTS: usize = 400;

/// Hits and looks by bins.
pub type Tally = [[f64; 2]; BINS];

/// The images that look at a sure object, and whether they have a vote.
pub struct LookedAt<'a> {
    /// The object.
    pub object: &'a Object,
    /// The images.
    pub images: Vec<(u32, bool)>,
}

/// The looks at sure objects up to `farthest_m`, of which no more are asked than tell.
#[must_use]
pub fn looked_at<'a>(model: &Model<'_>, lookout: &Lookout, sure: &[&'a Object], farthest_m: f64) -> Vec<LookedAt<'a>> {
    let looked_at = |object: &'a Object| {
        let images = lookout.seen(model, &object.fit.point, &object.votes, farthest_m);
        LookedAt { object, images }
    };
    sure.iter().step_by(sure.len().div_ceil(MOST_OBJECTS).max(1)).map(|&object| looked_at(object)).collect()
}

/// The share of the looks at sure objects that are hits, by distance up to `farthest_m`, over that where it is largest.
#[must_use]
pub fn reach(model: &Model<'_>, sure: &[LookedAt<'_>], farthest_m: f64) -> Steps {
    let mut tally = Tally::default();
    for LookedAt { object, images } in sure {
        for &(image, is_hit) in images {
            let distance_m = (model.scene.views[image as usize].center - object.fit.point).norm();
            count(&mut tally, distance_m / farthest_m, is_hit);
        }
    }
    relative(&tally).map_or(Steps::ONE, |shares| Steps::even(farthest_m, shares))
}

/// Count a look in the bin of a number.
pub fn count(tally: &mut Tally, part: f64, is_hit: bool) {
    let [hits, looks] = &mut tally[bin(part)];
    *hits += f64::from(u8::from(is_hit));
    *looks += 1.0;
}

/// The share of hits in each bin, over the largest, of the hits and looks there; nothing without hits. From where few looks were, objects are taken to be
/// seen as often as elsewhere: one look that is a hit does not make all others rare.
#[must_use]
pub fn relative(of_bins: &Tally) -> Option<[f64; BINS]> {
    let [hits, looks] = of_bins.iter().fold([0.0; 2], |sum, of_bin| [sum[0] + of_bin[0], sum[1] + of_bin[1]]);
    let shares = of_bins.map(|[of_hits, of_looks]| (of_hits + LEAST_LOOKS * hits / looks) / (of_looks + LEAST_LOOKS));
    let largest = shares.iter().copied().fold(0.0, f64::max);
    (largest > 0.0).then(|| shares.map(|share| share / largest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_look_that_is_a_hit_does_not_make_all_others_rare() {
        let mut of_bins = [[250.0, 1000.0]; BINS];
        of_bins[0] = [1.0, 1.0];
        let shares = relative(&of_bins).unwrap_or_default();
        assert!((shares[0] - 1.0).abs() < 1e-12 && (0.9..1.0).contains(&shares[6]), "{shares:?}");
    }

    #[test]
    fn objects_are_seen_less_from_where_they_were() {
        let mut of_bins = [[800.0, 1000.0]; BINS];
        of_bins[BINS - 1] = [200.0, 1000.0];
        let shares = relative(&of_bins).unwrap_or_default();
        assert!((shares[BINS - 1] - 0.25).abs() < 0.03 && (shares[0] - 1.0).abs() < 1e-12);
        assert_eq!(relative(&[[0.0; 2]; BINS]), None);
    }
}
