//! The plan of a bake: which stages and features a scene needs, and what is left out and why.

use super::indirect::bright_patches::Bright;
use super::indirect::sample_set::ROUND;
use super::{BakeParams, LightmapInfo, directional};
use crate::base::directional::Directional;
use crate::direct::DirectLight;
use crate::scene::{Light, Scene};

/// Bits of [`super::BakeStats::left_out`].
pub mod left_out {
    /// No indirect light: no photons, radiance map and gather map.
    pub const INDIRECT: u32 = 1 << 0;
    /// No photons and no estimate: no light is reflected more than once.
    pub const PHOTONS: u32 = 1 << 1;
    /// No direct light: the scene has no lights.
    pub const DIRECT: u32 = 1 << 2;
    /// No sampling of area lights.
    pub const AREA_LIGHTS: u32 = 1 << 3;
    /// No radiance of back sides.
    pub const BACK_SIDES: u32 = 1 << 4;
    /// No blur of the gather map.
    pub const BLUR: u32 = 1 << 5;
    /// No unwrapping: all meshes have usable UVs.
    pub const UNWRAP: u32 = 1 << 6;
    /// No interpolation of shading normals.
    pub const SHADING_NORMALS: u32 = 1 << 7;
    /// No look-ups of albedo textures.
    pub const TEXTURES: u32 = 1 << 8;
    /// No alpha tests for cut-outs.
    pub const CUTOUTS: u32 = 1 << 9;
    /// No light through transmissive surfaces.
    pub const TRANSMISSION: u32 = 1 << 10;
    /// No light from a sky.
    pub const SKY: u32 = 1 << 11;
    /// No directional light with a disc.
    pub const SUN_DISC: u32 = 1 << 12;
    /// No choice among many lights: all are few enough to be evaluated one by one.
    pub const MANY_LIGHTS: u32 = 1 << 13;
    /// No stitching of seams.
    pub const SEAMS: u32 = 1 << 14;
    /// No bright patches as lights: gather rays find most of the bright texels.
    pub const BRIGHT_PATCHES: u32 = 1 << 15;
    /// No light by direction (SH L1): nobody asks for it.
    pub const DIRECTIONAL: u32 = 1 << 16;
}

/// Stages and features that a bake of a scene runs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plan {
    /// Bits of [`left_out`].
    pub left_out: u32,
    lines: Vec<String>,
}

impl Plan {
    /// Derives the plan from the scene, its lights and the parameters.
    pub(crate) fn new(
        scene: &Scene,
        direct: &DirectLight,
        params: &BakeParams,
        two_sided: bool,
        unwrapped: bool,
    ) -> Plan {
        let mut plan = Plan { left_out: 0, lines: Vec::new() };
        let lights = scene.lights();
        let count = |f: fn(&Light) -> bool| lights.iter().filter(|l| f(l)).count();
        plan.lines.push(format!(
            "lights: {} point, {} spot, {} directional, {} rect, {} sky, {} emissive triangles",
            count(|l| matches!(l, Light::Point { .. })),
            count(|l| matches!(l, Light::Spot { .. })),
            count(|l| matches!(l, Light::Directional { .. })),
            count(|l| matches!(l, Light::Rect { .. })),
            count(|l| matches!(l, Light::Sky { .. })),
            scene.emitters().len(),
        ));
        let reflects = scene.materials().iter().any(|m| m.albedo.iter().any(|&a| a > 0.0));
        let no_indirect = if direct.is_dark() {
            Some("no light emits")
        } else if !reflects {
            Some("all albedos are 0")
        } else if params.gather_rays == 0 {
            Some("gather_rays is 0")
        } else {
            None
        };
        if direct.is_dark() {
            plan.leave_out(left_out::DIRECT, "direct light", "no light emits");
        } else {
            plan.run("direct light by shadow rays");
        }
        if direct.area_light_count() == 0 {
            plan.leave_out(left_out::AREA_LIGHTS, "sampling of area lights", "the scene has none");
        } else {
            plan.run(&format!("sampling of area lights, {} shadow rays per light", params.direct_samples));
        }
        plan.distant_and_many(direct, params.direct_samples);
        match no_indirect {
            Some(why) => {
                plan.leave_out(left_out::INDIRECT | left_out::PHOTONS, "photons, radiance map, gather map", why)
            }
            None => plan.indirect(params, two_sided),
        }
        if unwrapped {
            plan.run("unwrapping of meshes without light map UVs");
        } else {
            plan.leave_out(left_out::UNWRAP, "unwrapping", "all meshes have usable light map UVs");
        }
        if scene.meshes().iter().all(|m| m.normals.is_empty()) {
            plan.leave_out(left_out::SHADING_NORMALS, "interpolation of shading normals", "no mesh has vertex normals");
        } else {
            plan.run("interpolation of shading normals");
        }
        plan.materials(scene);
        plan.directional(params);
        plan.shared_light(scene);
        plan
    }

    /// Adds a line on instances that show the light of others.
    fn shared_light(&mut self, scene: &Scene) {
        match scene.instances().iter().filter(|i| i.light_of.is_some()).count() {
            0 => (),
            n => self.lines.push(format!("left out: texels of {n} instances (they show the light of others)")),
        }
    }

    /// Adds a line on light by direction.
    fn directional(&mut self, params: &BakeParams) {
        let of = match params.directional {
            0 => return self.leave_out(left_out::DIRECTIONAL, "light by direction (SH L1)", "directional is 0"),
            directional::INDIRECT => "indirect light",
            directional::DIRECT => "direct light",
            _ => "all light",
        };
        self.run(&format!("{of} by direction (SH L1), {} bytes per texel", size_of::<Directional>()));
    }

    /// Adds the features that materials need.
    fn materials(&mut self, scene: &Scene) {
        let uses = scene.uses();
        if uses.textures {
            let bytes: usize = scene.textures().iter().map(|t| t.bytes()).sum();
            self.run(&format!("albedo textures: {}, {bytes} bytes in all", scene.textures().len()));
        } else {
            self.leave_out(left_out::TEXTURES, "albedo textures", "no surface has one");
        }
        if uses.holes.is_empty() {
            self.leave_out(left_out::CUTOUTS, "alpha cut-outs", "no surface has any");
        } else {
            self.run(&format!("alpha cut-outs in {} materials", uses.holes.iter().filter(|&&h| h).count()));
        }
        if uses.transmission {
            self.run("light through transmissive sheets");
        } else {
            self.leave_out(left_out::TRANSMISSION, "light through transmissive sheets", "no surface transmits");
        }
    }

    fn distant_and_many(&mut self, direct: &DirectLight, samples: u32) {
        match direct.many_light_count() {
            0 => self.leave_out(left_out::MANY_LIGHTS, "sampling of many lights", "there are few enough to trace each"),
            n => self
                .run(&format!("sampling of {n} lights by a light tree, {} shadow rays for all of them", 4 * samples)),
        }
        match direct.disc_count() {
            0 => self.leave_out(left_out::SUN_DISC, "discs of directional lights", "none has an angular radius"),
            n => self.run(&format!("discs of {n} directional lights, {samples} shadow rays per light")),
        }
        match direct.sky_count() {
            0 => self.leave_out(left_out::SKY, "sky light", "the scene has no sky"),
            n => self.run(&format!("sky light of {n} skies, {} shadow rays", 4 * samples * n as u32)),
        }
    }

    fn indirect(&mut self, params: &BakeParams, two_sided: bool) {
        let photons = if params.photon_count == 0 {
            Some("photon_count is 0")
        } else if params.max_bounces == 1 {
            Some("max_bounces is 1")
        } else {
            None
        };
        match photons {
            Some(why) => self.leave_out(left_out::PHOTONS, "photons for light reflected more than once", why),
            None => self.run(&format!("{} photons for light reflected more than once", params.photon_count)),
        }
        self.run("radiance map");
        self.run(&format!("gather map, {} rays per texel", params.gather_rays));
        if params.near_hits == f32::INFINITY {
            self.run("paths from all hits of gather rays");
        } else if params.near_hits > 0.0 {
            self.run(&format!("paths from hits of gather rays nearer than {} radiance texels", params.near_hits));
        }
        if params.interpolation_error < f32::INFINITY {
            let most = params.interpolation_error;
            self.run(&format!("rays from texels where the gather map is too coarse: by an error of more than {most}"));
        }
        if params.interpolation_contrast < f32::INFINITY {
            let most = params.interpolation_contrast;
            self.run(&format!("rays from texels where the gather map's light has a contrast of more than {most}"));
        }
        if two_sided {
            self.run("radiance of back sides of two-sided materials");
        } else {
            self.leave_out(left_out::BACK_SIDES, "radiance of back sides", "no material is two-sided");
        }
        if params.blur_radius == 0 {
            self.leave_out(left_out::BLUR, "blur of the gather map", "blur_radius is 0");
        } else {
            self.run(&format!("blur of the gather map, radius {} texels", params.blur_radius));
        }
    }

    /// Adds lines on charts with separate texels for their backs, and on texels that nobody can see.
    pub(crate) fn note_sides(&mut self, info: &LightmapInfo) {
        if info.open_places > 0 {
            self.run(&format!(
                "visibility of both sides of surfaces from {} open places; {} rays, those for buried texels included",
                info.open_places, info.sight_rays
            ));
        }
        if info.buried_texels > 0 {
            self.run(&format!(
                "fill of {} buried texels, of {} in all, from the nearest visible ones",
                info.buried_texels, info.texels
            ));
        }
        if info.unseen_charts > 0 {
            self.run(&format!(
                "a single texel for each of {} charts that cannot be seen from the regions given, about {} texels less",
                info.unseen_charts, info.spared_texels
            ));
        }
        if info.both_sided_charts > 0 {
            self.run(&format!(
                "separate texels for the backs of {} two-sided charts: {} of {}",
                info.both_sided_charts, info.back_texels, info.texels
            ));
        }
    }

    /// Adds a line on two-sided charts whose back was baked.
    pub(crate) fn note_back_charts(&mut self, count: u64) {
        if count > 0 {
            self.run(&format!(
                "backs instead of fronts for {count} two-sided charts, where they see further or get more light"
            ));
        }
    }

    /// Adds a line on bright patches.
    pub(crate) fn note_bright(&mut self, bright: &Bright) {
        match bright.len() {
            0 if !self.runs(left_out::INDIRECT) => self.left_out |= left_out::BRIGHT_PATCHES,
            0 => {
                let why = "gather rays find most of the bright texels";
                self.leave_out(left_out::BRIGHT_PATCHES, "sampling of bright patches as lights", why);
            }
            n => {
                let rays = bright.shadow_rays();
                self.run(&format!(
                    "sampling of {n} bright patches as lights, {rays} shadow rays per {ROUND} gather rays"
                ));
            }
        }
    }

    /// Adds a line on stitched edges.
    pub(crate) fn run_seams(&mut self, edges: u64, unlike: u64) {
        let but = match unlike {
            0 => String::new(),
            n => format!(", except {n} points whose two sides face different ways or have very different light"),
        };
        self.run(&format!("stitching of seams at {edges} edges of smooth surfaces{but}"));
    }

    /// Adds a line on light that is kept.
    pub(crate) fn note_kept(&mut self, kept: u64, all: u64, keep_error: f32) {
        self.lines.push(format!(
            "left out: light of {kept} of {all} texels (it has changed by less than {keep_error} since the last bake)"
        ));
    }

    /// Adds a line on radiance that is kept.
    pub(crate) fn note_kept_radiance(&mut self, kept: u64, all: u64) {
        self.lines.push(format!(
            "left out: radiance of {kept} of {all} texels of the radiance map (lamps and photons reach them as before)"
        ));
    }

    /// Adds a line on why nothing was stitched.
    pub(crate) fn leave_out_seams(&mut self, why: &str) {
        self.leave_out(left_out::SEAMS, "stitching of seams", why);
    }

    fn run(&mut self, what: &str) {
        self.lines.push(format!("runs: {what}"));
    }

    fn leave_out(&mut self, bits: u32, what: &str, why: &str) {
        self.left_out |= bits;
        self.lines.push(format!("left out: {what} ({why})"));
    }

    /// Whether a part of the bake, given by its bit of [`left_out`], runs.
    pub(crate) fn runs(&self, bit: u32) -> bool {
        self.left_out & bit == 0
    }

    /// Makes a plan from its bits and its [`text`](Self::text).
    pub(crate) fn from_text(left_out: u32, text: &str) -> Plan {
        Plan { left_out, lines: text.lines().map(str::to_owned).collect() }
    }

    /// Returns the plan as text, one line per part.
    pub fn text(&self) -> String {
        self.lines.join("\n") + "\n"
    }
}
