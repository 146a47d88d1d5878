//! Confusions: the classes that a detector reports for objects of a class, `share_c(class)` of equation (4) of `docs/method.md`.

/// Of the detections of objects of each class, the shares that are said to be of other classes: few of all pairs of classes.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Confusions {
    /// By class of the object: said class, ascending, with its share.
    shares: Vec<Vec<(u32, f64)>>,
    /// Logarithm of what is left of each class: said to be what it is.
    ln_right: Vec<f64>,
    is_any: bool,
}

impl Confusions {
    /// From the said classes of each class and their shares; those of classes beyond are what they are said to be.
    #[must_use]
    pub fn of_shares(mut shares: Vec<Vec<(u32, f64)>>) -> Self {
        for (class, row) in (0..).zip(&mut shares) {
            row.retain(|&(said, share)| said != class && share > 0.0);
            row.sort_unstable_by_key(|&(said, _)| said);
            row.dedup_by_key(|&mut (said, _)| said);
        }
        let right = |row: &Vec<(u32, f64)>| 1.0 - row.iter().map(|(_, share)| share).sum::<f64>();
        let ln_right = shares.iter().map(|row| right(row).max(f64::MIN_POSITIVE).ln()).collect();
        let is_any = shares.iter().any(|row| !row.is_empty());
        Self { shares, ln_right, is_any }
    }

    /// What [`of_shares`](Self::of_shares) took.
    #[must_use]
    pub fn shares(&self) -> &[Vec<(u32, f64)>] {
        &self.shares
    }

    /// Whether any class is taken for another one.
    #[must_use]
    pub fn is_any(&self) -> bool {
        self.is_any
    }

    /// Logarithm of the share of the detections of an object of a class that are said to be of another one.
    #[inline]
    #[must_use]
    pub fn ln_share(&self, class: u32, said: u32) -> f64 {
        if class == said {
            return self.ln_right.get(class as usize).copied().unwrap_or(0.0);
        }
        let row = self.shares.get(class as usize).map_or(&[][..], Vec::as_slice);
        row.binary_search_by_key(&said, |&(said, _)| said).map_or(f64::NEG_INFINITY, |place| row[place].1.ln())
    }

    /// Whether an object of a class is ever taken for one of another.
    #[inline]
    #[must_use]
    pub fn may_be(&self, class: u32, said: u32) -> bool {
        class == said || (self.is_any && self.ln_share(class, said) > f64::NEG_INFINITY)
    }

    /// The class of an object that makes what it is said to be most probable.
    #[must_use]
    pub fn likeliest(&self, said: impl Iterator<Item = u32>) -> Option<u32> {
        let mut said = said;
        let first = said.next()?;
        if !self.is_any {
            return Some(first);
        }
        let mut all: Vec<u32> = std::iter::once(first).chain(said).collect();
        all.sort_unstable();
        let counts: Vec<(u32, f64)> = all.chunk_by(|a, b| a == b).map(|same| (same[0], same.len() as f64)).collect();
        let ln_likelihood =
            |class: u32| -> f64 { counts.iter().map(|&(said, count)| count * self.ln_share(class, said)).sum() };
        // An object is at times said to be what it is. Of what no class explains, most are right.
        let likelier = |a: &(u32, f64), b: &(u32, f64)| {
            ln_likelihood(a.0).total_cmp(&ln_likelihood(b.0)).then(a.1.total_cmp(&b.1)).then(b.0.cmp(&a.0))
        };
        counts.iter().copied().max_by(likelier).map(|(class, _)| class)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A third of what is of class 0 is said to be of class 1.
    fn confused() -> Confusions {
        Confusions::of_shares(vec![vec![(1, 1.0 / 3.0), (0, 0.5), (2, 0.0)], Vec::new()])
    }

    #[test]
    fn an_object_is_of_the_class_that_makes_what_it_is_said_to_be_most_probable() {
        assert_eq!(confused().likeliest([1, 0, 1].into_iter()), Some(0));
        assert_eq!(confused().likeliest([1, 1, 1].into_iter()), Some(1));
        assert_eq!(confused().likeliest([2, 0, 2].into_iter()), Some(2));
        assert_eq!(confused().likeliest(std::iter::empty()), None);
        assert_eq!(Confusions::default().likeliest([1, 0, 0].into_iter()), Some(1));
    }

    #[test]
    fn shares_are_those_that_are_stored() {
        let confused = confused();
        assert_eq!(confused.shares(), [vec![(1, 1.0 / 3.0)], Vec::new()]);
        assert!(confused.is_any() && confused.may_be(0, 1) && !confused.may_be(1, 0) && confused.may_be(1, 1));
        assert!((confused.ln_share(0, 0) - (2.0_f64 / 3.0).ln()).abs() < 1e-12);
        assert!(confused.ln_share(9, 9).abs() < 1e-300 && !confused.may_be(9, 0));
        assert_eq!(Confusions::of_shares(confused.shares().to_vec()), confused);
        assert!(!Confusions::default().is_any() && Confusions::default().ln_share(1, 1).abs() < 1e-300);
    }
}
