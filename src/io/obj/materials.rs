//! Materials of faces by their names, from libraries and their images.

use super::mtl::{self, MapFile};
use super::{Reader, base_name};
use crate::base::error::Result;
use crate::io::{DEFAULT_ALBEDO, Import, TWO_SIDED_UNLESS_SAID, texture};
use crate::scene::{Material, NONE};
use std::collections::HashMap;

impl Reader<'_, '_> {
    /// Adds the materials that faces use, in the order of their names' first use, and returns the
    /// material of each name. Names without a description share one grey material.
    pub(super) fn add_materials(&mut self) -> Result<Vec<u32>> {
        let mut by_entry = HashMap::<Option<&[u8]>, u32>::new();
        let mut materials = vec![NONE; self.names.len()];
        let (mut unknown, mut images) = (Vec::new(), Images::new());
        for (name, material) in self.names.iter().zip(&mut materials).filter(|(name, _)| name.faces > 0) {
            let base = base_name(&name.text);
            let (key, entry) = match (self.library.get(&name.text), self.library.get(base)) {
                (Some(entry), _) => (Some(&name.text[..]), entry.clone()),
                (None, Some(entry)) => (Some(base), entry.clone()),
                (None, None) => (None, mtl::Entry::default()),
            };
            if key.is_none() && !name.text.is_empty() {
                unknown.push(String::from_utf8_lossy(base));
            }
            *material = match by_entry.get(&key) {
                Some(id) => *id,
                None => {
                    let material = described(self.import, &mut images, &entry)?;
                    let id = self.import.add_material(material)?;
                    by_entry.insert(key, id);
                    id
                }
            };
        }
        unknown.sort();
        unknown.dedup();
        if let [first, ..] = &unknown[..] {
            let what = format!("{} materials have no description (first: {first:?}) and are grey", unknown.len());
            self.import.warn(what);
        }
        Ok(materials)
    }
}

/// Texture and alpha cutoff by the files of `map_Kd` and `map_d`.
type Images = HashMap<(Option<MapFile>, Option<MapFile>), (u32, f32)>;

/// The material of a library's entry.
fn described(import: &mut Import, images: &mut Images, entry: &mtl::Entry) -> Result<Material> {
    let maps = (entry.color_map.clone(), entry.alpha_map.clone());
    let (albedo_texture, alpha_cutoff) = match images.get(&maps) {
        Some(known) => *known,
        None => {
            let image = add_image(import, &maps.0, &maps.1)?;
            *images.entry(maps).or_insert(image)
        }
    };
    // Where a map gives the colour, the factor is white unless said.
    let grey = if entry.color_map.is_some() && albedo_texture != NONE { 1.0 } else { DEFAULT_ALBEDO };
    let emits = entry.emission.iter().any(|&e| e > 0.0);
    Ok(Material {
        albedo: entry.albedo.unwrap_or([grey; 3]),
        emission: entry.emission,
        two_sided: TWO_SIDED_UNLESS_SAID,
        albedo_texture,
        alpha_cutoff: if emits { 0.0 } else { alpha_cutoff },
        transmission: entry.transmission(),
    })
}

/// Reads the images of a material into one; [`NONE`] without any.
fn add_image(import: &mut Import, color: &Option<MapFile>, alpha: &Option<MapFile>) -> Result<(u32, f32)> {
    let mut read = |file: &Option<MapFile>| match file {
        Some(file) => {
            let image = texture::read(import, &file.folder, &file.name);
            import.image(&file.name, image)
        }
        None => Ok(None),
    };
    let colors = read(color)?;
    let alphas = if alpha == color { None } else { read(alpha)? };
    let image = match (colors, alphas) {
        (colors, Some(alpha)) => {
            let both = texture::with_alpha(colors, &alpha, &mut import.account)?;
            import.account.give_back(alpha.bytes());
            both
        }
        (Some(colors), None) => colors,
        (None, None) => return Ok((NONE, 0.0)),
    };
    let cutoff = if texture::is_opaque(&image) { 0.0 } else { texture::CUTOFF };
    Ok((import.add_texture(texture::flipped(image))?, cutoff))
}
