//! Confusions: the classes that a detector reports for objects of a class, learned from the map.
//!
//! They are `share_c(class)` of equation (4) of `docs/method.md`. A detector gives an object one box. Boxes of another class belong
//! to an object if they lie in its gate more often in images without a vote of its own class than in images with one. What stands
//! beside the object is there in both.

use std::collections::BTreeMap;

use super::is_sure;
use crate::robust::energy::Object;
use crate::robust::energy::looks::Lookout;
use crate::robust::model::Model;
use crate::robust::model::confusions::Confusions;
use crate::robust::noise::index::RayIndex;

/// What objects of one class tell, each of which counts as one: neighbors stay where they are from image to image.
#[derive(Default, Clone)]
struct Tally {
    objects: f64,
    /// Votes of all.
    votes: f64,
    /// By said class: boxes in place of votes, beyond those that stand beside it; and their squares, object by object.
    instead: BTreeMap<u32, (f64, f64)>,
    /// The same of all classes together.
    of_any: (f64, f64),
}

/// Learn them from a map: those that are more than chance by as many standard deviations as a gate has. Of classes of so few objects that
/// nothing could be, as many detections are confused as of all classes together.
#[must_use]
pub fn confusions(model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, objects: &[Object]) -> Confusions {
    let sigmas = model.settings.gate_sigmas;
    let mut tallies: Vec<Tally> = vec![Tally::default(); model.classes.len()];
    for object in objects.iter().filter(|object| is_sure(object)) {
        tallies[object.class as usize].count(model, lookout, index, object);
    }
    let votes: f64 = tallies.iter().map(|tally| tally.votes).sum();
    let instead: f64 = tallies.iter().map(|tally| tally.of_any.0).sum();
    let squares: f64 = tallies.iter().map(|tally| tally.of_any.1).sum();
    let pooled = if is_more(instead, squares, sigmas) { instead / (votes + instead) } else { 0.0 };
    let seen: Vec<(u32, f64)> =
        (0..).zip(&tallies).map(|(class, tally)| (class, tally.votes)).filter(|(_, votes)| *votes > 0.0).collect();
    let of_class = |tally: &Tally| -> Vec<(u32, f64)> {
        if tally.objects >= sigmas * sigmas || !(tally.objects > 0.0 && pooled > 0.0) {
            return tally.shares(sigmas);
        }
        let others = votes - tally.votes;
        seen.iter().map(|&(said, of_said)| (said, pooled * of_said / others)).filter(|row| row.1.is_finite()).collect()
    };
    Confusions::of_shares(tallies.iter().map(of_class).collect())
}

/// Whether a sum, of which the sum of squares is given as well, is more than chance.
fn is_more(sum: f64, squares: f64, sigmas: f64) -> bool {
    sum > sigmas * squares.sqrt()
}

impl Tally {
    fn count(&mut self, model: &Model<'_>, lookout: &Lookout, index: &RayIndex<'_>, object: &Object) {
        let scene = model.scene;
        let image = |ray: u32| scene.image_of(ray);
        let is_own = |ray: &&u32| scene.class_of(**ray) == object.class;
        let voting: Vec<u32> = object.votes.iter().filter(is_own).map(|&ray| image(ray)).collect();
        let votes = voting.len() as f64;
        let missing = f64::from(lookout.expected(scene, &object.fit.point, &object.votes)) - votes;
        let reach_m = model.classes[object.class as usize].farthest_m;
        let hits = index.hits_of_any(&object.places(model), &|said| said != object.class, reach_m);
        let mut said: Vec<(u32, u32)> = hits.iter().map(|hit| (scene.class_of(hit.ray), hit.image)).collect();
        said.sort_unstable();
        said.dedup();
        let instead = |of_class: &[(u32, u32)]| {
            let beside = of_class.iter().filter(|(_, image)| voting.binary_search(image).is_ok()).count() as f64;
            (of_class[0].0, of_class.len() as f64 - beside - beside * missing / votes)
        };
        let instead: Vec<(u32, f64)> = said.chunk_by(|a, b| a.0 == b.0).map(instead).collect();
        // What most boxes take for something else is something else.
        if instead.iter().any(|(_, instead)| *instead > votes) {
            return;
        }
        self.objects += 1.0;
        self.votes += votes;
        let any: f64 = instead.iter().map(|(_, instead)| instead).sum();
        self.of_any = (self.of_any.0 + any, self.of_any.1 + any * any);
        for (said, instead) in instead {
            let sums = self.instead.entry(said).or_default();
            *sums = (sums.0 + instead, sums.1 + instead * instead);
        }
    }

    /// The said classes of the objects of one, and their shares of its detections.
    fn shares(&self, sigmas: f64) -> Vec<(u32, f64)> {
        let more = self.instead.iter().filter(|(_, (instead, squares))| is_more(*instead, *squares, sigmas));
        let more: Vec<(u32, f64)> = more.map(|(&said, &(instead, _))| (said, instead)).collect();
        let all = self.votes + more.iter().map(|(_, more)| more).sum::<f64>();
        more.into_iter().map(|(said, more)| (said, more / all)).collect()
    }
}
