//! Results and checkpoints of a small room, damaged record by record, with all checksums put right: whatever is
//! accepted shows light that is finite and not negative, and can be saved again.

use crate::records::{Records, place};
use crate::room;
use bakelite::lightmap::{BakeParams, CheckpointParams, Layer, LayerData, Lightmap};
use bakelite::{Error, Progress};
use std::path::{Path, PathBuf};

/// A light map, and a true file of it.
pub struct Saved {
    lightmap: Lightmap,
    records: Records,
    /// Where the true file is.
    truth: PathBuf,
    /// Where damaged ones are put.
    input: PathBuf,
}

/// Parameters of the bakes whose files are damaged.
pub fn params() -> BakeParams {
    BakeParams { photon_count: 500, gather_rays: 4, direct_samples: 1, ..Default::default() }
}

fn checkpoint(path: &Path) -> CheckpointParams {
    CheckpointParams { path: path.to_owned(), seconds: 0.0 }
}

impl Saved {
    /// The result of a bake.
    pub fn result() -> Saved {
        let (mut lightmap, truth) = (room::lightmap(), place("result"));
        lightmap.bake(&params(), &Progress::none()).expect("a bake");
        lightmap.save_result(&truth, &Progress::none()).expect("a result");
        Saved::new(lightmap, truth, place("result-input"))
    }

    /// The checkpoint of a complete bake.
    pub fn checkpoint() -> Saved {
        let (mut lightmap, truth) = (room::lightmap(), place("checkpoint"));
        lightmap.bake_with(&params(), Some(&checkpoint(&truth)), &Progress::none()).expect("a bake");
        Saved::new(lightmap, truth, place("checkpoint-input"))
    }

    fn new(lightmap: Lightmap, truth: PathBuf, input: PathBuf) -> Saved {
        Saved { lightmap, records: Records::read(&truth), truth, input }
    }

    /// Loads the damaged result over the true one.
    pub fn load(&mut self, changes: &[u8]) {
        self.records.write_changed(changes, &self.input);
        match self.lightmap.load_result(&self.input, &Progress::none()) {
            Ok(()) => {
                let light = check_light(&self.lightmap);
                self.lightmap.save_result(&self.input, &Progress::none()).expect("what was loaded can be saved");
                self.lightmap.load_result(&self.input, &Progress::none()).expect("what was saved can be loaded");
                assert!(check_light(&self.lightmap) == light, "what was saved comes back");
                self.lightmap.load_result(&self.truth, &Progress::none()).expect("the true result");
            }
            Err(e) => check_error(&e),
        }
    }

    /// Goes on from the damaged checkpoint.
    pub fn resume(&mut self, changes: &[u8]) {
        self.records.write_changed(changes, &self.input);
        match self.lightmap.bake_with(&params(), Some(&checkpoint(&self.input)), &Progress::none()) {
            Ok(_) => drop(check_light(&self.lightmap)),
            Err(e) => check_error(&e),
        }
    }
}

impl Drop for Saved {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.truth);
        let _ = std::fs::remove_file(&self.input);
    }
}

/// Checks that light is finite and not negative, and returns the bits of all layers.
pub fn check_light(lightmap: &Lightmap) -> Vec<u32> {
    let mut bits = Vec::new();
    for layer in [Layer::Combined, Layer::Indirect, Layer::Direct, Layer::Radiance, Layer::Validity] {
        let values = match lightmap.read(0, layer).expect("a layer") {
            LayerData::Rgb(v) => v.into_flattened(),
            LayerData::Scalar(v) => v,
            LayerData::Integer(_) => Vec::new(),
        };
        assert!(values.iter().all(|c| c.is_finite() && *c >= 0.0), "{layer:?}");
        bits.extend(values.iter().map(|c| c.to_bits()));
    }
    bits
}

/// Checks that an error is one that a damaged file may bring.
pub fn check_error(e: &Error) {
    use Error::*;
    assert!(matches!(e, Io(_) | InvalidArgument(_) | InvalidState(_) | OutOfMemory(_)), "{e}");
}
