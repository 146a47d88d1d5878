//! What tells real objects from false things beside the looks at them, of one class.

use super::steps::Steps;

/// What is learned of one class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Existing {
    /// How much more probable a mean score is of what is real, in logarithms.
    pub by_score: Steps,
    /// How much more probable the nearness of the nearest sure object is.
    pub by_nearness: Steps,
    /// How much more probable it is that its nearest vote is so near.
    pub by_approach: Steps,
    /// What is added to the logarithm of all odds, so that as many are real as the looks say.
    pub ln_odds: f64,
}

impl Existing {
    /// Nothing beside J and looks tells.
    pub const UNTOLD: Self =
        Self { by_score: Steps::NONE, by_nearness: Steps::NONE, by_approach: Steps::NONE, ln_odds: 0.0 };

    /// As many numbers.
    pub const NUMBERS: usize = 3 * Steps::NUMBERS + 1;

    /// As numbers, for storage.
    #[must_use]
    pub fn to_row(&self) -> Vec<f64> {
        let steps = [&self.by_score, &self.by_nearness, &self.by_approach].map(Steps::to_row);
        steps.iter().flatten().copied().chain([self.ln_odds]).collect()
    }

    /// What `to_row` returned.
    #[must_use]
    pub fn from_row(row: &[f64; Self::NUMBERS]) -> Option<Self> {
        let (by_score, rest) = row.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (by_nearness, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let (by_approach, rest) = rest.split_first_chunk::<{ Steps::NUMBERS }>()?;
        let &[ln_odds] = rest else { return None };
        let [by_score, by_nearness, by_approach] = [by_score, by_nearness, by_approach].map(Steps::from_row);
        Some(Self { by_score, by_nearness, by_approach, ln_odds })
    }

    /// Whether nothing does.
    #[must_use]
    pub fn tells_nothing(&self) -> bool {
        [&self.by_score, &self.by_nearness, &self.by_approach].iter().all(|steps| **steps == Steps::NONE)
    }
}
