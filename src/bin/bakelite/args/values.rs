//! Values of flags in forms of their own. Errors say what is wrong; which flag has which value is said by clap.

use bakelite::Light;
use bakelite::bvh::BuildOptions;
use bakelite::lightmap::{BakeParams, CheckpointParams, LightmapDesc, Region};
use bakelite::scene::{Camera, NONE, is_builtin};
use glam::Vec3;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// A light of the command line.
#[derive(Clone, Debug)]
pub struct GivenLight {
    /// Of a sky, up is still to be set.
    pub light: Light,
    /// Of a sky.
    pub image: Option<PathBuf>,
}

/// Parameters of the library, which knows their ranges.
pub trait Parameters: Default {
    fn check(&self) -> bakelite::Result<()>;
}

impl Parameters for LightmapDesc {
    fn check(&self) -> bakelite::Result<()> {
        self.validate()
    }
}

impl Parameters for BakeParams {
    fn check(&self) -> bakelite::Result<()> {
        self.validate()
    }
}

impl Parameters for BuildOptions {
    fn check(&self) -> bakelite::Result<()> {
        self.validate()
    }
}

/// Parses the value of a parameter that `set` sets, within the range that the library allows.
pub fn of<P: Parameters, T: FromStr + Clone>(set: fn(&mut P, T)) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| {
        let value: T = number(text)?;
        let mut all = P::default();
        set(&mut all, value.clone());
        // The library's sentences begin with its name of the parameter and the value.
        let range = |text: String| text.split_once(", ").map_or(text.clone(), |(_, range)| range.to_owned());
        all.check().map_err(|e| range(e.to_string()))?;
        Ok(value)
    }
}

/// Seconds between two writes of a checkpoint.
pub fn checkpoint_seconds(text: &str) -> Result<f64, String> {
    let seconds = number(text)?;
    let range = |text: String| text.split_once(", ").map_or(text.clone(), |(_, range)| range.to_owned());
    CheckpointParams { path: PathBuf::new(), seconds }.validate().map_err(|e| range(e.to_string()))?;
    Ok(seconds)
}

/// A number, or what it is not.
pub fn number<T: FromStr>(value: &str) -> Result<T, String> {
    let kind = if "0.5".parse::<T>().is_ok() { "a number" } else { "a whole number in range" };
    value.parse().map_err(|_| format!("not {kind}"))
}

/// A finite number greater than 0.
pub fn positive(value: &str) -> Result<f64, String> {
    match number(value)? {
        s if s > 0.0 && f64::is_finite(s) => Ok(s),
        _ => Err("not a finite number greater than 0".into()),
    }
}

/// A finite number that is not negative.
pub fn not_negative(value: &str) -> Result<f64, String> {
    match number(value)? {
        s if s >= 0.0 && f64::is_finite(s) => Ok(s),
        _ => Err("not a finite number of at least 0".into()),
    }
}

/// The name of a built-in scene or of a file that has one of the known endings.
pub fn scene(value: &str) -> Result<String, String> {
    if is_scene(value) {
        return Ok(value.to_owned());
    }
    Err(format!(
        "neither a built-in scene ({}) nor a file (.obj, .ply, .gltf, .glb)",
        bakelite::scene::BUILTIN_NAMES.join(", ")
    ))
}

/// Whether a word looks like a scene: what has the form of a file is left to the reader of files.
pub fn is_scene(value: &str) -> bool {
    is_builtin(value) || value.contains(['.', '/', '\\']) || Path::new(value).exists()
}

/// A file that holds a committed scene.
pub fn scene_file(value: &str) -> Result<PathBuf, String> {
    if is_scene_file(value) { Ok(value.into()) } else { Err("its name does not end in .bkscene".into()) }
}

/// Whether this is the name of a file that holds a committed scene.
pub fn is_scene_file(name: &str) -> bool {
    Path::new(name).extension().is_some_and(|e| e.eq_ignore_ascii_case("bkscene"))
}

/// Which part of the texels, counted from 0, and of how many.
pub fn shard(value: &str) -> Result<[u64; 2], String> {
    let parts: Option<(u64, u64)> = value.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((i, n)) if (1..=n).contains(&i) => Ok([i - 1, n]),
        _ => Err("not I/N with I from 1 to N".into()),
    }
}

/// `N` numbers with commas between them.
fn tuple<const N: usize>(what: &str, value: &str) -> Result<[f32; N], String> {
    let numbers: Result<Vec<f32>, _> = value.split(',').map(|n| n.trim().parse::<f32>()).collect();
    numbers.ok().and_then(|n| n.try_into().ok()).ok_or_else(|| {
        let form = if N == 2 { "a,b" } else { "a,b,c" };
        format!("the {what} {value:?} is not {N} numbers {form}")
    })
}

/// A point, or a box by its least and greatest coordinates.
pub fn region(value: &str) -> Result<Region, String> {
    let corners: Vec<[f32; 3]> = value.split(':').map(|corner| tuple("corner", corner)).collect::<Result<_, _>>()?;
    let [lower, upper] = match corners[..] {
        [point] => [point; 2],
        [lower, upper] => [lower, upper],
        _ => return Err(format!("the region {value:?} is not a point x,y,z or a box x,y,z:x,y,z")),
    };
    let region = Region { lower: lower.into(), upper: upper.into() };
    let desc = LightmapDesc { seen_from: vec![region], ..LightmapDesc::default() };
    desc.validate().map_err(|_| format!("the region {value:?} is not finite, or its corners do not ascend"))?;
    Ok(region)
}

/// A light.
pub fn light(value: &str) -> Result<GivenLight, String> {
    let fields: Vec<&str> = value.split(':').collect();
    let vector = |i: usize, what: &str| tuple::<3>(what, fields[i]).map(Vec3::from);
    let color = |i: usize| tuple::<3>("colour", fields[i]);
    let light = match (fields[0], fields.len()) {
        ("point", 3) => Light::Point { position: vector(1, "position")?, intensity: color(2)? },
        ("sun", 3 | 4) => {
            let degrees = if fields.len() == 4 { number::<f32>(fields[3])? } else { 0.0 };
            let (direction, irradiance) = (vector(1, "direction")?, color(2)?);
            Light::Directional { direction, irradiance, angular_radius: degrees.to_radians() }
        }
        ("sky", 2 | 3) => return sky(&fields),
        ("spot", 5) => {
            let [inner, outer] = tuple::<2>("cone", fields[3])?.map(f32::to_radians);
            let (position, direction) = (vector(1, "position")?, vector(2, "direction")?);
            Light::Spot { position, direction, inner, outer, intensity: color(4)? }
        }
        ("rect", 5) => Light::Rect {
            position: vector(1, "corner")?,
            edge_u: vector(2, "edge u")?,
            edge_v: vector(3, "edge v")?,
            radiance: color(4)?,
        },
        (kind @ ("point" | "sun" | "spot" | "rect" | "sky"), n) => {
            let expected = match kind {
                "point" => "3",
                "sun" => "3 or 4",
                "sky" => "2 or 3",
                _ => "5",
            };
            return Err(format!("there are {n} parts between colons, a {kind} has {expected} (see --help)"));
        }
        (kind, _) => return Err(format!("the kind {kind:?} is not point, spot, sun, sky or rect")),
    };
    light.validate().map_err(|e| e.to_string())?;
    Ok(GivenLight { light, image: None })
}

/// A colour for all directions, or an image.
fn sky(fields: &[&str]) -> Result<GivenLight, String> {
    let sky = |radiance| Light::Sky { radiance, environment: NONE, up: Vec3::Y, rotation: 0.0 };
    let is_image = [".hdr", ".exr"].iter().any(|e| fields[1].to_lowercase().ends_with(e));
    let given = if is_image {
        let scale = if fields.len() == 3 { number(fields[2])? } else { 1.0 };
        GivenLight { light: sky([scale; 3]), image: Some(fields[1].into()) }
    } else if fields.len() == 3 {
        return Err(format!("{:?} is not a .hdr or .exr file, and a colour has no scale", fields[1]));
    } else {
        GivenLight { light: sky(tuple::<3>("colour", fields[1])?), image: None }
    };
    given.light.validate().map_err(|e| e.to_string())?;
    Ok(given)
}

/// A camera, whose `up` is not set.
pub fn camera(value: &str) -> Result<Camera, String> {
    let fields: Vec<&str> = value.split(':').collect();
    if !(2..=3).contains(&fields.len()) {
        return Err("not position:target or position:target:fov".into());
    }
    let position = Vec3::from(tuple::<3>("position", fields[0])?);
    let target = Vec3::from(tuple::<3>("target", fields[1])?);
    let degrees: f32 = fields.get(2).map_or(Ok(60.0), |f| number(f))?;
    if !position.is_finite() || !target.is_finite() || position == target {
        return Err("position and target are not two finite points".into());
    }
    if !(0.1..=170.0).contains(&degrees) {
        return Err(format!("the field of view is {degrees}, outside 0.1 to 170 degrees"));
    }
    Ok(Camera { position, target, up: Vec3::ZERO, fov_y: degrees.to_radians() })
}
