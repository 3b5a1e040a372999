//! Shares of a bake of a small room, one of them damaged record by record, with all checksums put right: whatever is
//! accepted gives light that is finite and not negative.

use crate::records::{Records, place};
use crate::room;
use crate::saved::{check_error, check_light, params};
use bakelite::Progress;
use bakelite::lightmap::{Lightmap, ShareParams, ShareStage};
use std::path::PathBuf;

const COUNT: u32 = 2;

/// A light map, and the true files of its shares.
pub struct Shares {
    lightmap: Lightmap,
    params: ShareParams,
    photons: Records,
    radiance: Records,
}

impl Shares {
    pub fn of_room() -> Shares {
        let lightmap = room::lightmap();
        let share = ShareParams { prefix: place("share-"), count: COUNT };
        for stage in [ShareStage::Photons, ShareStage::Radiance] {
            for i in 0..COUNT {
                lightmap.bake_share(&params(), &share, stage, i, &Progress::none()).expect("a share");
            }
        }
        let read = |kind: &str| Records::read(&file(&share, kind, 1));
        let (photons, radiance) = (read("photons"), read("radiance"));
        Shares { lightmap, params: share, photons, radiance }
    }

    /// Damages the second share of the radiance map, which a bake reads then, or, if the first byte is odd, that of photons,
    /// which the radiance map is made from. The bytes behind it are the changes.
    pub fn read(&mut self, bytes: &[u8]) {
        let Some((&first, changes)) = bytes.split_first() else { return };
        let radiance = file(&self.params, "radiance", 1);
        if first % 2 == 1 {
            let photons = file(&self.params, "photons", 1);
            self.photons.write_changed(changes, &photons);
            std::fs::remove_file(&radiance).expect("the share of the radiance map");
            let made = self.lightmap.bake_share(&params(), &self.params, ShareStage::Radiance, 1, &Progress::none());
            made.as_ref().map_or_else(check_error, |_| self.bake());
            self.photons.write_changed(&[], &photons);
        } else {
            self.radiance.write_changed(changes, &radiance);
            self.bake();
        }
        self.radiance.write_changed(&[], &radiance);
    }

    fn bake(&mut self) {
        match self.lightmap.bake_with_shares(&params(), Some(&self.params), None, &Progress::none()) {
            Ok(_) => drop(check_light(&self.lightmap)),
            Err(e) => check_error(&e),
        }
    }
}

fn file(params: &ShareParams, kind: &str, share: u32) -> PathBuf {
    let mut name = params.prefix.clone().into_os_string();
    name.push(format!("{kind}-{share}-of-{COUNT}.bkshare"));
    name.into()
}

impl Drop for Shares {
    fn drop(&mut self) {
        for kind in ["photons", "radiance"] {
            for share in 0..COUNT {
                let _ = std::fs::remove_file(file(&self.params, kind, share));
            }
        }
    }
}
