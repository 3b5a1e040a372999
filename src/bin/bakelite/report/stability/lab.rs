//! What the cases of `bakelite report stability` work with: rows with verdicts, a device that keeps its warnings,
//! texels.

use crate::args::BakeArgs;
use crate::job::Job;
use bakelite::bvh::BuildOptions;
use bakelite::device::LogLevel;
use bakelite::lightmap::{BakeParams, Layer, LayerData, Lightmap, LightmapDesc};
use bakelite::scene::{BUILTIN_NAMES, NONE, builtin};
use bakelite::{Device, DeviceOptions, Error, Material, Progress, Result, Scene, SceneData};
use glam::Vec3;
use std::sync::{Arc, Mutex};

/// What a row says about a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Within the tolerance, or refused as documented.
    Ok,
    /// Outside of the tolerance where the documentation says so, or after a warning.
    Degrades,
    Fails,
}

impl Verdict {
    pub fn text(self) -> &'static str {
        match self {
            Verdict::Ok => "ok",
            Verdict::Degrades => "degrades as documented",
            Verdict::Fails => "FAILS",
        }
    }
}

/// One measurement.
#[derive(Clone, Debug)]
pub struct Row {
    pub case: &'static str,
    pub parameter: String,
    /// The parameter as a number, for the plot.
    pub x: f64,
    pub expected: f64,
    pub got: f64,
    /// |got − expected| by what it is relative to.
    pub error: f64,
    pub verdict: Verdict,
    pub note: String,
}

impl Row {
    /// A value. Its error is relative to the value expected.
    pub fn new(case: &'static str, parameter: impl ToString, x: f64, expected: f64, got: f64) -> Row {
        let error = (got - expected).abs();
        let error = if expected == 0.0 { error } else { error / expected.abs() };
        Row {
            case,
            parameter: parameter.to_string(),
            x,
            expected,
            got,
            error,
            verdict: Verdict::Fails,
            note: String::new(),
        }
    }

    /// An error that has been computed already; 0 is expected.
    pub fn of_error(case: &'static str, parameter: impl ToString, x: f64, error: f64) -> Row {
        Row::new(case, parameter, x, 0.0, error)
    }

    /// A mean of light of which only that it is finite and not negative can be said.
    pub fn sound(case: &'static str, parameter: impl ToString, mean: f64) -> Row {
        let unsound = if mean.is_finite() && mean >= 0.0 { 0.0 } else { f64::NAN };
        Row::of_error(case, parameter, 0.0, unsound).within(0.0)
    }

    /// Gives the verdict. (NaN fails.)
    pub fn within(mut self, tolerance: f64) -> Row {
        self.verdict = if self.error <= tolerance { Verdict::Ok } else { Verdict::Fails };
        self
    }

    /// Whether a failure is one that the caller was told of.
    pub fn or_degrades(mut self, told: bool) -> Row {
        if self.verdict == Verdict::Fails && told && self.got.is_finite() {
            self.verdict = Verdict::Degrades;
        }
        self
    }

    pub fn note(mut self, note: impl Into<String>) -> Row {
        self.note = note.into();
        self
    }

    /// Something that must be refused, with a sentence that contains `part`.
    pub fn refusal<T>(case: &'static str, parameter: impl ToString, result: Result<T>, part: &str) -> Row {
        let row = Row::of_error(case, parameter, 0.0, 0.0);
        match result {
            Err(e) if e.to_string().contains(part) => Row { verdict: Verdict::Ok, ..row }.note(format!("refused: {e}")),
            Err(e) => row.note(format!("refused for another reason: {e}")),
            Ok(_) => row.note("was not refused"),
        }
    }
}

/// A covered texel of a baked light map.
#[derive(Clone, Copy, Debug)]
pub struct Texel {
    pub triangle: u32,
    pub position: Vec3,
    pub normal: Vec3,
    pub value: Vec3,
}

/// What the cases work with.
pub struct Lab<'a> {
    pub args: &'a BakeArgs,
    pub device: Arc<Device>,
    /// Few and small parameters, for tests.
    pub quick: bool,
    warnings: Arc<Mutex<Vec<String>>>,
}

impl<'a> Lab<'a> {
    pub fn new(args: &'a BakeArgs, quick: bool) -> Result<Lab<'a>> {
        let warnings = Arc::new(Mutex::new(Vec::new()));
        let log = {
            let warnings = warnings.clone();
            move |level: LogLevel, message: &str| {
                if level <= LogLevel::Warning {
                    warnings.lock().unwrap_or_else(|e| e.into_inner()).push(message.to_owned());
                }
            }
        };
        let options =
            DeviceOptions { num_threads: args.threads, isa: args.isa, log: Some(Box::new(log)), ..Default::default() };
        Ok(Lab { args, device: Device::new(options)?, quick, warnings })
    }

    pub fn commit(&self, data: SceneData) -> Result<Arc<Scene>> {
        Scene::commit(&self.device, data, &BuildOptions::default(), &Progress::none()).map_err(|(_, e)| e)
    }

    pub fn baked(&self, data: SceneData, desc: &LightmapDesc, params: &BakeParams) -> Result<Lightmap> {
        let mut map = Lightmap::create(&self.commit(data)?, desc, &Progress::none())?;
        map.bake(params, &Progress::none())?;
        Ok(map)
    }

    /// Warnings logged since the last call.
    pub fn take_warnings(&self) -> Vec<String> {
        std::mem::take(&mut self.warnings.lock().unwrap_or_else(|e| e.into_inner()))
    }

    /// All parameters, or for a quick look every third, the last (most extreme) among them.
    pub fn some<T: Copy>(&self, all: &[T]) -> Vec<T> {
        let mut some: Vec<T> = all.iter().rev().copied().step_by(if self.quick { 3 } else { 1 }).collect();
        some.reverse();
        some
    }
}

/// A grey material.
pub fn diffuse(albedo: f32) -> Material {
    Material { albedo: [albedo; 3], ..Default::default() }
}

/// A small light map: a second or less.
pub fn small_desc() -> LightmapDesc {
    LightmapDesc { page_size: 128, gather_divisor: 2, radiance_divisor: 4, ..Default::default() }
}

pub fn small_bake() -> BakeParams {
    BakeParams { photon_count: 50_000, gather_rays: 64, direct_samples: 8, ..Default::default() }
}

/// The covered texels of all pages.
pub fn texels(map: &Lightmap, layer: Layer) -> Result<Vec<Texel>> {
    let mut out = Vec::new();
    let rgb = |page, layer| match map.read(page, layer)? {
        LayerData::Rgb(v) => Ok(v),
        _ => Err(Error::Internal(format!("layer {layer:?} is not RGB"))),
    };
    for page in 0..map.info().page_count {
        let LayerData::Integer(triangles) = map.read(page, Layer::Triangle)? else { continue };
        let [positions, normals, values] = [rgb(page, Layer::Position)?, rgb(page, Layer::Normal)?, rgb(page, layer)?];
        for (i, &triangle) in triangles.iter().enumerate().filter(|(_, t)| **t != NONE) {
            let [position, normal, value] = [positions[i], normals[i], values[i]].map(Vec3::from);
            out.push(Texel { triangle, position, normal, value });
        }
    }
    Ok(out)
}

/// Mean over texels and channels; NaN if one is not finite or negative.
pub fn mean(texels: &[Texel]) -> f64 {
    let sound = texels.iter().all(|t| t.value.is_finite() && t.value.min_element() >= 0.0);
    let sum: f64 = texels.iter().map(|t| t.value.as_dvec3().element_sum() / 3.0).sum();
    if sound { sum / texels.len().max(1) as f64 } else { f64::NAN }
}

/// The largest channel of any texel; NaN if one is not finite or negative.
pub fn largest(texels: &[Texel]) -> f64 {
    let largest = texels.iter().map(|t| t.value.max_element() as f64).fold(0.0, f64::max);
    if mean(texels).is_nan() { f64::NAN } else { largest }
}

/// Root of the mean square of the first channel's deviation from `expected`, by the root of the mean square of
/// what is expected.
pub fn deviation(texels: &[Texel], expected: impl Fn(&Texel) -> f64) -> f64 {
    let (mut squares, mut scale) = (0.0, 0.0);
    for t in texels {
        let e = expected(t);
        squares += (t.value.x as f64 - e).powi(2);
        scale += e * e;
    }
    (squares / scale).sqrt()
}

/// A case: adds its rows.
pub type Case = fn(&Lab, &mut Vec<Row>) -> Result<()>;

/// The built-in scenes, and the one asked for if it is another.
pub fn scenes(args: &BakeArgs) -> Result<Vec<(String, SceneData)>> {
    let mut scenes = Vec::new();
    for name in BUILTIN_NAMES {
        scenes.push((name.to_string(), builtin(name)?));
    }
    if !BUILTIN_NAMES.contains(&args.scene.as_str()) {
        scenes.push((args.scene.clone(), Job::new(args).load_dark()?));
    }
    Ok(scenes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn verdicts_follow_from_errors_and_what_was_told() {
        let row = |got| Row::new("c", "p", 1.0, 2.0, got).within(0.1);
        assert_eq!(
            (row(2.1).verdict, row(2.3).verdict, row(f64::NAN).verdict),
            (Verdict::Ok, Verdict::Fails, Verdict::Fails)
        );
        assert_eq!(row(2.3).or_degrades(true).verdict, Verdict::Degrades);
        assert_eq!(row(f64::NAN).or_degrades(true).verdict, Verdict::Fails);
        let refused: Result<()> = Err(Error::InvalidArgument("radius is -1".into()));
        assert_eq!(Row::refusal("c", "p", refused.clone(), "radius").verdict, Verdict::Ok);
        assert_eq!(Row::refusal("c", "p", refused, "photons").verdict, Verdict::Fails);
        assert_eq!(Row::refusal("c", "p", Ok(()), "radius").verdict, Verdict::Fails);
    }
}
