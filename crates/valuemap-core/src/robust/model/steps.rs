//! The score of a detection and its elevation in the picture: what they say of votes against clutter.
//!
//! Both are densities by bins, learned from the map. The ratio of scores is monotone (isotonic regression, pool adjacent violators); elevations of clutter
//! are compared with all that the cameras look at, and are told apart no better than they are measured.

/// Values are sorted into so many bins of about as many detections each. More would have fewer detections each to tell them, fewer would be coarser.
pub const BINS: usize = 12;
/// Fewer of one kind tell nothing: their number is known no better than to a third, and a ratio to one as large no better than to a half (Poisson).
pub(crate) const LEAST_DETECTIONS: f64 = 10.0;

/// A function that is constant between some edges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steps {
    /// Ascending; infinite where there are fewer.
    edges: [f64; BINS - 1],
    values: [f64; BINS],
}

impl Steps {
    /// 0 everywhere.
    pub const NONE: Self = Self { edges: [f64::INFINITY; BINS - 1], values: [0.0; BINS] };

    /// 1 everywhere.
    pub const ONE: Self = Self { edges: [f64::INFINITY; BINS - 1], values: [1.0; BINS] };

    /// Some values, each of as long a part of what is between 0 and `most`.
    #[must_use]
    pub fn even(most: f64, values: [f64; BINS]) -> Self {
        Self { edges: std::array::from_fn(|i| most * (i + 1) as f64 / BINS as f64), values }
    }

    /// As many numbers.
    pub const NUMBERS: usize = 2 * BINS - 1;

    /// As numbers, for storage.
    #[must_use]
    pub fn to_row(&self) -> [f64; Self::NUMBERS] {
        std::array::from_fn(|place| self.edges.get(place).copied().unwrap_or_else(|| self.values[place + 1 - BINS]))
    }

    /// What `to_row` returned.
    #[must_use]
    pub fn from_row(row: &[f64; Self::NUMBERS]) -> Self {
        Self { edges: std::array::from_fn(|i| row[i]), values: std::array::from_fn(|i| row[BINS - 1 + i]) }
    }

    /// The value there; 0 for what is not a number.
    #[inline]
    #[must_use]
    pub fn at(&self, x: f64) -> f64 {
        if x.is_nan() { 0.0 } else { self.values[self.bin(x)] }
    }

    #[inline]
    fn bin(&self, x: f64) -> usize {
        self.edges.partition_point(|edge| *edge <= x)
    }

    /// Edges so that about as many of some numbers are in each bin; `values` are 0. Numbers within a `resolution` are not told apart: an edge is halfway
    /// between two that are farther from each other, and bins are no narrower.
    fn of_quantiles(numbers: impl Iterator<Item = f64>, resolution: f64) -> Self {
        let mut sorted: Vec<f64> = numbers.filter(|number| number.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        let mut steps = Self::NONE;
        let halfway = |i: usize| {
            let above = *sorted.get(sorted.len() * i / BINS)?;
            // Nothing is below the least.
            let first = sorted.partition_point(|&number| number < above - resolution);
            let below = sorted[..first].last()?;
            Some(0.5 * (below + sorted[first]))
        };
        let mut edges: Vec<f64> = (1..BINS).filter_map(halfway).collect();
        edges.dedup_by(|next, edge| *next - *edge <= resolution);
        steps.edges.iter_mut().zip(edges).for_each(|(edge, value)| *edge = value);
        steps
    }

    /// The sum of some weights in each bin.
    fn sums(&self, numbers: impl Iterator<Item = (f64, f64)>) -> [f64; BINS] {
        let mut sums = [0.0; BINS];
        numbers.filter(|(number, _)| number.is_finite()).for_each(|(number, weight)| sums[self.bin(number)] += weight);
        sums
    }
}

/// Of the even bins between 0 and 1 the one of a number, the last one of larger ones.
#[must_use]
pub fn bin(part: f64) -> usize {
    ((part * BINS as f64) as usize).min(BINS - 1)
}

/// How much more probable, in logarithms, votes have a score than clutter has; it does not fall with the score.
#[must_use]
pub fn score_ratio(votes: &[f64], clutter: &[f64]) -> Steps {
    let of_votes = votes.iter().map(|&score| (score, [1.0, 0.0]));
    let of_clutter = clutter.iter().map(|&score| (score, [0.0, 1.0]));
    rising_ratio(&of_votes.chain(of_clutter).collect::<Vec<_>>())
}

/// How much more probable, in logarithms, a number is of one kind of thing than of another, if it does not fall with the number; each number comes with
/// the probabilities that it is of either kind. Nothing is told by few of one kind.
#[must_use]
pub fn rising_ratio(numbers: &[(f64, [f64; 2])]) -> Steps {
    let finite = || numbers.iter().copied().filter(|(number, _)| number.is_finite());
    let [first, other] = finite().fold([0.0; 2], |sums, (_, of)| [sums[0] + of[0], sums[1] + of[1]]);
    if first.min(other) < LEAST_DETECTIONS {
        return Steps::NONE;
    }
    let mut steps = Steps::of_quantiles(finite().map(|(number, _)| number), 0.0);
    let used = steps.edges.iter().filter(|edge| edge.is_finite()).count() + 1;
    let of_first = steps.sums(finite().map(|(number, of)| (number, of[0])));
    let of_other = steps.sums(finite().map(|(number, of)| (number, of[1])));
    // Pooled where the share of the first kind falls (pool adjacent violators), with one more of each kind in each pool.
    let mut pools: Vec<(f64, f64, usize)> = Vec::with_capacity(used);
    for bin in 0..used {
        pools.push((of_first[bin], of_other[bin], 1));
        while let [.., (a0, b0, n0), (a1, b1, n1)] = pools[..] {
            if (a1 + 1.0) * (b0 + 1.0) >= (a0 + 1.0) * (b1 + 1.0) {
                break;
            }
            pools.truncate(pools.len() - 2);
            pools.push((a0 + a1, b0 + b1, n0 + n1));
        }
    }
    let mut bin = 0;
    for (a, b, bins) in pools {
        let ratio = ((a + 1.0) / (first + used as f64)) / ((b + 1.0) / (other + used as f64));
        steps.values[bin..bin + bins].fill(ratio.ln());
        bin += bins;
    }
    steps
}

/// How much denser, in logarithms, clutter is at some sines of elevation, which are measured to a `resolution`, than it would be if all heights that
/// are `looked_at` had as much.
#[must_use]
pub fn elevation_factor(clutter: &[f64], looked_at: (f64, f64), resolution: f64) -> Steps {
    if (clutter.len() as f64) < LEAST_DETECTIONS || looked_at.1 <= looked_at.0 {
        return Steps::NONE;
    }
    let mut steps = Steps::of_quantiles(clutter.iter().copied(), resolution);
    let used = steps.edges.iter().filter(|edge| edge.is_finite()).count() + 1;
    let counts = steps.sums(clutter.iter().map(|&sine| (sine, 1.0)));
    for (bin, count) in counts.into_iter().enumerate().take(used) {
        let from = if bin == 0 { looked_at.0 } else { steps.edges[bin - 1] };
        let to = if bin + 1 == used { looked_at.1 } else { steps.edges[bin] };
        let share = (count + 1.0) / (clutter.len() + used) as f64;
        let width = ((to - from) / (looked_at.1 - looked_at.0)).max(f64::MIN_POSITIVE);
        steps.values[bin] = (share / width).ln();
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn votes_have_higher_scores() {
        let votes: Vec<f64> = (0..200).map(|i| 0.5 + f64::from(i % 50) / 100.0).collect();
        let clutter: Vec<f64> = (0..200).map(|i| f64::from(i % 60) / 100.0).collect();
        let ratio = score_ratio(&votes, &clutter);
        assert!(ratio.at(0.95) > 1.0 && ratio.at(0.1) < -1.0);
        let scores: Vec<f64> = (0..100).map(|i| ratio.at(f64::from(i) / 100.0)).collect();
        assert!(scores.is_sorted());
        assert!(ratio.at(f64::NAN).abs() < 1e-12 && score_ratio(&votes, &[0.5; 3]) == Steps::NONE);
    }

    #[test]
    fn steps_are_what_is_stored_of_them() {
        let steps = elevation_factor(&(0..300).map(f64::from).collect::<Vec<_>>(), (-10.0, 400.0), 0.1);
        assert_eq!(Steps::from_row(&steps.to_row()), steps);
        assert_eq!(Steps::from_row(&Steps::ONE.to_row()), Steps::ONE);
        assert!((Steps::even(120.0, std::array::from_fn(|i| i as f64)).at(65.0) - 6.0).abs() < 1e-12);
    }

    #[test]
    fn clutter_is_dense_where_it_is() {
        let clutter: Vec<f64> = (0..300).map(|i| 0.1 + f64::from(i) / 3000.0).collect();
        let factor = elevation_factor(&clutter, (-1.0, 1.0), 1e-3);
        assert!((factor.at(0.15) - 20.0_f64.ln()).abs() < 0.2);
        assert!(factor.at(-0.5) < 0.0 && factor.at(0.9) < 0.0);
    }

    #[test]
    fn clutter_on_a_grid_is_as_dense_as_clutter_between() {
        // On a grid of ten rows, each off by rounding: as many in each as if they were spread.
        let clutter: Vec<f64> = (0..300).map(|i| f64::from(i % 10) / 10.0 + f64::from(i) * 1e-16).collect();
        let factor = elevation_factor(&clutter, (-0.05, 0.95), 0.01);
        assert!((0..10).all(|row| factor.at(f64::from(row) / 10.0).abs() < 0.8), "{factor:?}");
        let all: f64 = (0..1000).map(|i| factor.at(-0.05 + f64::from(i) / 1000.0).exp() / 1000.0).sum();
        assert!((all - 1.0).abs() < 1e-2, "{all}");
    }
}
