//! Detection rate by distance: the share of the looks at a class that are hits, over that where it is largest.
//!
//! It weighs looks from afar in equation (5) of `docs/method.md`, where a miss says less.

use super::clutter::{BINS, Steps};
use super::energy::Object;
use super::learn::LEAST_LOOKS;
use super::looks::Lookout;
use super::model::Model;

/// Objects that tell, at most: a share of some thousand looks is known to 1 %.
pub const MOST_OBJECTS: usize = 400;

/// The share of the looks at sure objects that are hits, by distance up to `farthest_m`, over that where it is largest.
#[must_use]
pub fn reach(model: &Model<'_>, lookout: &Lookout, sure: &[&Object], farthest_m: f64) -> Steps {
    let mut of_bins = [[0.0; 2]; BINS];
    for object in sure.iter().step_by(sure.len().div_ceil(MOST_OBJECTS).max(1)) {
        let point = &object.fit.point;
        for (image, is_hit) in lookout.seen(model, point, &object.votes, farthest_m) {
            let distance_m = (model.scene.views[image as usize].center - point).norm();
            let of_bin = &mut of_bins[((distance_m / farthest_m * BINS as f64) as usize).min(BINS - 1)];
            *of_bin = [of_bin[0] + f64::from(u8::from(is_hit)), of_bin[1] + 1.0];
        }
    }
    relative(&of_bins).map_or(Steps::ONE, |shares| Steps::even(farthest_m, shares))
}

/// The share of hits in each bin, over the largest, of the hits and looks there; nothing without hits. From where few looks were, objects are taken to be
/// seen as often as elsewhere: one look that is a hit does not make all others rare.
#[must_use]
pub fn relative(of_bins: &[[f64; 2]; BINS]) -> Option<[f64; BINS]> {
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
