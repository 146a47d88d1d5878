//! Which images should have seen an object: its looks.
//!
//! A look is a viewpoint of a pass with an image that has the point in its picture, from a direction and a distance from which the
//! object was voted for. A viewpoint that has a vote is a hit. Where another detection lies in the point's gate, the object may be
//! hidden behind that one, or be one with it in the picture: half a look.

use nalgebra::Vector3;
use rstar::RTree;
use rstar::primitives::GeomWithData;
use rustc_hash::FxHashMap;

use super::energy::Object;
use super::model::{ClassModel, Model, Rates};
use super::scene::Scene;

/// Images are grouped by cubes of this share of the range: some hundred cubes are in reach of a point.
const CUBE_SHARE: f64 = 1.0 / 6.0;
/// Half of the angle of a sector (cosine of 15 degrees): housings and faces are detected about so much farther to the side than
/// the farthest vote, and no more is known.
const SECTOR_COSINE: f64 = 0.966;
/// A look at a point where another detection is counts so much: hidden as often as not.
const HIDDEN_LOOK: f64 = 0.5;

/// Looks of one pass at an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Looks {
    /// Viewpoints that should have seen it.
    pub expected: f64,
    /// Viewpoints that did.
    pub hits: f64,
}

/// All looks at an object.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Seen {
    /// By sector, and there by pass.
    pub sectors: Vec<Vec<Looks>>,
    /// Images that should have seen it.
    pub images: u32,
}

/// Logarithms of how probable the looks of one sector are: if the object is seen from there as usual, and if in any share of the looks, one for all
/// passes or each its own.
struct OfSector {
    usual: f64,
    any: f64,
    hits: f64,
    expected: f64,
}

impl OfSector {
    fn new(passes: &[Looks], class: &ClassModel) -> Self {
        let (mut usual, mut each, mut hits, mut expected) = (0.0, 0.0, 0.0, 0.0);
        for pass in passes {
            let any = Rates::ANY.log_likelihood(pass.hits, pass.expected);
            let as_usual = class.rates.log_likelihood(pass.hits, pass.expected);
            usual += ((1.0 - class.odd_passes) * as_usual.exp() + class.odd_passes * any.exp()).ln();
            each += any;
            hits += pass.hits;
            expected += pass.expected;
        }
        let any = ln_sum(each, Rates::ANY.log_likelihood(hits, expected)) - std::f64::consts::LN_2;
        Self { usual, any, hits, expected }
    }

    /// From as many directions an object is seen as usual as it is not.
    fn either(&self) -> f64 {
        ln_sum(self.usual, self.any) - std::f64::consts::LN_2
    }
}

/// `ln(e^a + e^b)`.
fn ln_sum(a: f64, b: f64) -> f64 {
    a.max(b) + (-(a - b).abs()).exp().ln_1p()
}

impl Seen {
    /// Logarithms of how probable the looks are at a real object, which is seen as usual from where it has most votes, and at a false thing.
    #[must_use]
    pub fn log_likelihoods(&self, class: &ClassModel) -> (f64, f64) {
        let sectors: Vec<OfSector> = self.sectors.iter().map(|passes| OfSector::new(passes, class)).collect();
        let more = |a: &&OfSector, b: &&OfSector| a.hits.total_cmp(&b.hits).then(a.expected.total_cmp(&b.expected));
        let main = sectors.iter().max_by(more).map_or(0.0, |main| main.usual - main.either());
        let real = main + sectors.iter().map(OfSector::either).sum::<f64>();
        let strange = sectors.iter().map(|sector| sector.any).sum::<f64>();
        (real + (-class.false_share).ln_1p(), strange + class.false_share.ln())
    }

    /// Logarithm of how probable the looks are at anything, real or false.
    #[must_use]
    pub fn ln_likelihood(&self, class: &ClassModel) -> f64 {
        let (real, strange) = self.log_likelihoods(class);
        ln_sum(real, strange)
    }

    /// Passes that see an object, or should have from where others do; and minus the logarithm of how probable it is of those without a hit
    /// to have none.
    #[must_use]
    pub fn missed(&self, class: &ClassModel) -> (usize, f64) {
        let passes = self.sectors.iter().flatten().filter(|pass| pass.expected > 0.0);
        let missed = passes.clone().filter(|pass| pass.hits == 0.0);
        (passes.count(), missed.map(|pass| -OfSector::new(&[*pass], class).usual).sum())
    }

    /// Probability that what has these looks is real rather than false.
    #[must_use]
    pub fn real(&self, class: &ClassModel) -> f64 {
        (self.log_likelihoods(class).0 - self.ln_likelihood(class)).exp()
    }

    /// The looks of all passes; how probable it is that they are from where the object is usually seen, and that it is seen as usual on
    /// this pass as well.
    #[must_use]
    pub fn usual(&self, class: &ClassModel) -> Vec<(Looks, f64, f64)> {
        let of_sector = |passes: &Vec<Looks>| {
            let sector = OfSector::new(passes, class);
            let visible = (sector.usual - ln_sum(sector.usual, sector.any)).exp();
            let of_pass = move |pass: &Looks| {
                let usual = (1.0 - class.odd_passes) * class.rates.log_likelihood(pass.hits, pass.expected).exp();
                let any = class.odd_passes * Rates::ANY.log_likelihood(pass.hits, pass.expected).exp();
                (*pass, visible, visible * usual / (usual + any))
            };
            passes.iter().map(of_pass).collect::<Vec<_>>()
        };
        self.sectors.iter().flat_map(of_sector).collect()
    }
}

/// All images by place.
pub struct Lookout {
    cubes: RTree<GeomWithData<[f64; 3], Vec<u32>>>,
    reach_m: f64,
}

impl Lookout {
    /// Index all images of a scene of which objects are seen up to about `range_m`.
    #[must_use]
    pub fn new(scene: &Scene, range_m: f64) -> Self {
        let side = range_m * CUBE_SHARE;
        let mut images: FxHashMap<[i64; 3], Vec<u32>> = FxHashMap::default();
        for (image, view) in (0..).zip(&scene.views) {
            let cube = [0, 1, 2].map(|axis| (view.center[axis] / side).floor() as i64);
            images.entry(cube).or_default().push(image);
        }
        let middle = |cube: [i64; 3]| cube.map(|index| (index as f64 + 0.5) * side);
        let cubes = images.into_iter().map(|(cube, images)| GeomWithData::new(middle(cube), images));
        Self { cubes: RTree::bulk_load(cubes.collect()), reach_m: 0.5 * side * 3.0_f64.sqrt() }
    }

    /// All images within a distance of a point, and some farther ones, in no order.
    fn around(&self, point: &Vector3<f64>, distance_m: f64) -> impl Iterator<Item = u32> {
        let reach = distance_m + self.reach_m;
        self.cubes.locate_within_distance((*point).into(), reach * reach).flat_map(|near| near.data.iter().copied())
    }

    /// The looks at a point that some rays (one per image, ascending) vote for; `others` are images (ascending) with a detection in its gate.
    #[must_use]
    pub fn looks(&self, model: &Model<'_>, point: &Vector3<f64>, voters: &[u32], others: &[u32]) -> Seen {
        let nearest_m = voters.first().map_or(f64::INFINITY, |&ray| model.class_of(ray).nearest_m);
        self.looks_within(model, point, voters, others, (nearest_m, 0.0), |_| 1.0)
    }

    /// The same, with looks from as near and as far as the class is detected: few votes do not tell from where their object is seen.
    #[must_use]
    pub fn looks_of_few(&self, model: &Model<'_>, point: &Vector3<f64>, voters: &[u32]) -> Seen {
        let Some(class) = voters.first().map(|&ray| model.class_of(ray)) else { return Seen::default() };
        self.looks_within(model, point, voters, &[], (0.0, class.farthest_m), |distance_m| class.reach.at(distance_m))
    }

    /// Tells of objects whether all images in reach of them have only detections among some rays: their votes are counted in full.
    pub fn whole<'a>(&'a self, model: &'a Model<'_>, rays: &[u32]) -> impl Fn(&Object) -> bool {
        let mut is_left_out = vec![false; model.scene.views.len()];
        let image = |ray: u32| model.scene.rays.image[ray as usize] as usize;
        for ray in model.scene.usable_rays() {
            is_left_out[image(ray)] = true;
        }
        for &ray in rays {
            is_left_out[image(ray)] = false;
        }
        move |object| {
            let reach_m = model.classes[object.class as usize].farthest_m;
            let point = &object.fit.point;
            let is_near = |&image: &u32| (model.scene.views[image as usize].center - point).norm() <= reach_m;
            !self.around(point, reach_m).filter(is_near).any(|image| is_left_out[image as usize])
        }
    }

    /// How far the images are, m, that look at a point from where some rays vote for it, up to `farthest_m`, and whether they have a vote.
    #[must_use]
    pub fn distances_m(
        &self,
        model: &Model<'_>,
        point: &Vector3<f64>,
        voters: &[u32],
        farthest_m: f64,
    ) -> Vec<(f64, bool)> {
        let scene = model.scene;
        let sectors = Sectors::of(scene, point, voters, (0.0, farthest_m));
        let mut hits: Vec<u32> = voters.iter().map(|&ray| scene.rays.image[ray as usize]).collect();
        hits.sort_unstable();
        let distance_m = |image: u32| (scene.views[image as usize].center - point).norm();
        let is_looking = |&image: &u32| {
            let view = &scene.views[image as usize];
            let is_here = || sectors.holding(&(view.center - point)).is_some();
            distance_m(image) <= farthest_m && is_here() && scene.is_in_picture(view, point)
        };
        let looking = self.around(point, farthest_m).filter(is_looking);
        looking.map(|image| (distance_m(image), hits.binary_search(&image).is_ok())).collect()
    }

    /// The looks from the distances of the votes, and those given; one without a vote counts as much of a look as `weight` says.
    fn looks_within(
        &self,
        model: &Model<'_>,
        point: &Vector3<f64>,
        voters: &[u32],
        others: &[u32],
        distances_m: (f64, f64),
        weight: impl Fn(f64) -> f64,
    ) -> Seen {
        let scene = model.scene;
        let sectors = Sectors::of(scene, point, voters, distances_m);
        let farthest = sectors.0.iter().map(|sector| sector.farthest_m).fold(0.0, f64::max);
        let mut looks: Vec<Look> = Vec::with_capacity(2 * voters.len());
        for &ray in voters {
            let view = scene.view(ray);
            let sector = sectors.nearest(&(view.center - point));
            looks.push(Look { sector, image: scene.rays.image[ray as usize], weight: 1.0, is_hit: true });
        }
        let mut hits = looks.iter().map(|look| look.image).collect::<Vec<u32>>();
        hits.sort_unstable();
        for image in self.around(point, farthest) {
            let view = &scene.views[image as usize];
            let Some(sector) = sectors.holding(&(view.center - point)) else { continue };
            if hits.binary_search(&image).is_err() && scene.is_in_picture(view, point) {
                let hidden = if others.binary_search(&image).is_ok() { HIDDEN_LOOK } else { 1.0 };
                let weight = hidden * weight((view.center - point).norm());
                looks.push(Look { sector, image, weight, is_hit: false });
            }
        }
        // Images are numbered along the drives: sorted, those of a viewpoint are side by side.
        looks.sort_unstable_by_key(|look| (look.sector, look.image));
        let images = looks.len() as u32;
        let view = |look: &Look| &scene.views[look.image as usize];
        let of_pass = |pass: &[Look]| {
            let mut sum = Looks { expected: 0.0, hits: 0.0 };
            for images in pass.chunk_by(|a, b| view(a).viewpoint == view(b).viewpoint) {
                let hit = images.iter().any(|image| image.is_hit);
                sum.hits += f64::from(u8::from(hit));
                sum.expected += if hit { 1.0 } else { images.iter().map(|image| image.weight).fold(0.0, f64::max) };
            }
            sum
        };
        let of_sector = |sector: &[Look]| sector.chunk_by(|a, b| view(a).pass == view(b).pass).map(of_pass).collect();
        let sectors = looks.chunk_by(|a, b| a.sector == b.sector).map(of_sector).collect();
        Seen { sectors, images }
    }
}

/// An image that should have seen an object.
struct Look {
    sector: usize,
    image: u32,
    weight: f64,
    is_hit: bool,
}

/// From where an object is seen.
struct Sectors(Vec<Sector>);

struct Sector {
    /// The middle, from the object.
    direction: Vector3<f64>,
    /// What is nearer is seen by few: that of the nearest vote, or of the class.
    nearest_m: f64,
    farthest_m: f64,
}

impl Sectors {
    fn of(scene: &Scene, point: &Vector3<f64>, voters: &[u32], (nearest_m, farthest_m): (f64, f64)) -> Self {
        let mut sectors: Vec<Sector> = Vec::new();
        for &ray in voters {
            let away = scene.ray(ray).center - point;
            let distance = away.norm();
            let direction = away / distance;
            if let Some(sector) = sectors.iter_mut().find(|sector| sector.direction.dot(&direction) >= SECTOR_COSINE) {
                sector.nearest_m = sector.nearest_m.min(distance);
                sector.farthest_m = sector.farthest_m.max(distance);
            } else {
                sectors.push(Sector {
                    direction,
                    nearest_m: nearest_m.min(distance),
                    farthest_m: farthest_m.max(distance),
                });
            }
        }
        Self(sectors)
    }

    /// The sector that holds a camera that is so far away.
    fn holding(&self, away: &Vector3<f64>) -> Option<usize> {
        let distance = away.norm();
        let holds = |sector: &Sector| {
            distance >= sector.nearest_m
                && distance <= sector.farthest_m
                && sector.direction.dot(away) >= SECTOR_COSINE * distance
        };
        self.0.iter().position(holds)
    }

    /// The sector of a vote from so far away.
    fn nearest(&self, away: &Vector3<f64>) -> usize {
        self.holding(away).unwrap_or_else(|| {
            let cosines = self.0.iter().map(|sector| sector.direction.dot(away));
            cosines.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(sector, _)| sector)
        })
    }
}
