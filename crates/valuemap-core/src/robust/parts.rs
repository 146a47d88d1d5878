//! The parts of the method, each of which can be left out in tests and ablations: a part that no scene misses does not belong here.

/// A move of the search, a term of J, or what is done once before or after the search.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// What proposes labels of the initial map is estimated on all that votes for it.
    Polishing,
    /// All objects compete for all rays, image by image.
    Assignment,
    /// An object gives way to neighbours that may have its votes.
    Dissolution,
    /// Two objects become one.
    Merging,
    /// Two objects exchange what they have on a visit or from a side.
    Exchanges,
    /// Two objects exchange what images show of one of them alone.
    ContestedExchanges,
    /// Two objects exchange what they have from near.
    NearExchanges,
    /// Neighborhoods are destroyed and repaired.
    Repair,
    /// Objects of few visits are tried in parts.
    Halves,
    /// The two best parts of an object are tried whatever they cost.
    TwoForOne,
    /// Objects are born of what is left over.
    Births,
    /// Objects are born with votes of others.
    TakenVotes,
    /// Images that show both of two neighbours say which is which.
    Untangling,
    /// Solid things are not in one place.
    Exclusion,
    /// What begins to be seen where another object ends is that object.
    IdentitySwitches,
    /// What a camera sees in turn with another object, and never together, is that object.
    Copies,
    /// Boxes of one object tell one size.
    Sizes,
    /// An object stands as far away as measured.
    Ranges,
    /// Objects of a class are about as high.
    Heights,
    /// Scores tell votes from clutter.
    Scores,
    /// Clutter is denser at some elevations.
    Elevations,
    /// Clutter is denser beside objects that are missed.
    Tails,
    /// Objects are detected less from afar.
    Reach,
    /// A hit is as rare as a look from so far is light.
    FarHits,
    /// Objects are detected less from directions that are farther from those of their votes.
    Aspect,
    /// Objects are denser near others.
    Company,
    /// Scores, company and approach tell which objects exist.
    Existence,
    /// What hardly any look sees is a ghost, as many are.
    Ghosts,
    /// What stays at its place of the picture is no object.
    Carried,
    /// Who should have seen an object and did not.
    Looks,
    /// Images of one viewpoint do not show now one of two objects and now the other.
    Turns,
    /// Classes that are taken for each other.
    Confusions,
    /// What the images of a visit share of their pose errors.
    SharedNoise,
    /// Nearer ranges are tried where objects are detected less than is usual.
    NearerRanges,
    /// The noise is split between poses and detections by what the objects of an image have in common.
    NoiseSplit,
    /// Successive looks of a visit err alike.
    Memory,
    /// Sides of an object show other middles.
    Sides,
    /// Contested votes widen covariances.
    Contest,
    /// Covariances are scaled by how far passes disagree.
    Scaling,
}

impl Part {
    /// All parts with their names.
    pub const ALL: [(Self, &'static str); 39] = [
        (Self::Polishing, "polishing"),
        (Self::Assignment, "assignment"),
        (Self::Dissolution, "dissolution"),
        (Self::Merging, "merging"),
        (Self::Exchanges, "exchanges"),
        (Self::ContestedExchanges, "contested_exchanges"),
        (Self::NearExchanges, "near_exchanges"),
        (Self::Repair, "repair"),
        (Self::Halves, "halves"),
        (Self::TwoForOne, "two_for_one"),
        (Self::Births, "births"),
        (Self::TakenVotes, "taken_votes"),
        (Self::Untangling, "untangling"),
        (Self::Exclusion, "exclusion"),
        (Self::IdentitySwitches, "identity_switches"),
        (Self::Copies, "copies"),
        (Self::Sizes, "sizes"),
        (Self::Ranges, "ranges"),
        (Self::Heights, "heights"),
        (Self::Scores, "scores"),
        (Self::Elevations, "elevations"),
        (Self::Tails, "tails"),
        (Self::Reach, "reach"),
        (Self::FarHits, "far_hits"),
        (Self::Aspect, "aspect"),
        (Self::Company, "company"),
        (Self::Existence, "existence"),
        (Self::Ghosts, "ghosts"),
        (Self::Carried, "carried"),
        (Self::Looks, "looks"),
        (Self::Turns, "turns"),
        (Self::Confusions, "confusions"),
        (Self::SharedNoise, "shared_noise"),
        (Self::NearerRanges, "nearer_ranges"),
        (Self::NoiseSplit, "noise_split"),
        (Self::Memory, "memory"),
        (Self::Sides, "sides"),
        (Self::Contest, "contest"),
        (Self::Scaling, "scaling"),
    ];
}

/// Parts that are left out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Without(u64);

impl Without {
    /// None.
    pub const NOTHING: Self = Self(0);

    /// The parts of these names; the first name that is none.
    ///
    /// # Errors
    /// A name that no part has.
    pub fn named(names: &[String]) -> Result<Self, &str> {
        names.iter().try_fold(Self::NOTHING, |without, name| {
            let (part, _) = Part::ALL.iter().find(|(_, of_part)| of_part == name).ok_or(name.as_str())?;
            Ok(Self(without.0 | 1 << *part as u64))
        })
    }

    /// Whether a part is left out.
    #[inline]
    #[must_use]
    pub const fn has(self, part: Part) -> bool {
        self.0 >> part as u64 & 1 == 1
    }
}
