//! Materials with their images, and the light map page of each texture.

use super::Reader;
use super::buffers::read_uri;
use crate::base::error::{Error, Result};
use crate::io::source::Attempt;
use crate::io::texture;
use crate::scene::{Material, NONE, Texture};
use gltf::material::AlphaMode;
use std::collections::{BTreeSet, HashMap};

/// Texture that a material reads through `TEXCOORD_1`.
pub(super) fn lightmap_texture(material: &gltf::Material) -> Option<usize> {
    let base = material.pbr_metallic_roughness().base_color_texture();
    let textures = [
        base.map(|t| (t.tex_coord(), t.texture().index())),
        material.occlusion_texture().map(|t| (t.tex_coord(), t.texture().index())),
        material.emissive_texture().map(|t| (t.tex_coord(), t.texture().index())),
    ];
    textures.into_iter().flatten().find(|(tex_coord, _)| *tex_coord == 1).map(|(_, texture)| texture)
}

/// The light map page of each texture that is used as one.
pub(super) fn lightmap_pages(document: &gltf::Document) -> HashMap<usize, u32> {
    let textures: BTreeSet<_> = document.materials().filter_map(|m| lightmap_texture(&m)).collect();
    textures.into_iter().zip(0..).collect()
}

impl Reader<'_, '_> {
    pub(super) fn material(&mut self, material: &gltf::Material) -> Result<u32> {
        if let Some(id) = self.materials.get(&material.index()) {
            return Ok(*id);
        }
        let pbr = material.pbr_metallic_roughness();
        let mut albedo_texture = NONE;
        match (pbr.base_color_texture(), material.index()) {
            (Some(info), _) if info.tex_coord() == 0 => {
                albedo_texture = self.texture(info.texture().source().index())?;
            }
            (Some(info), Some(index)) if info.tex_coord() > 1 => drop(self.textured.insert(index)),
            _ => {}
        }
        let [r, g, b, alpha] = pbr.base_color_factor();
        let strength = material.emissive_strength().unwrap_or(1.0);
        let emission = material.emissive_factor().map(|e| e * strength);
        if let Err(Error::InvalidArgument(what)) = crate::scene::check_energy("the emission", &emission) {
            return self.malformed(what);
        }
        let emits = emission.iter().any(|&e| e > 0.0);
        // Of the texture's alpha alone. What is less opaque than that everywhere cannot be seen.
        let mut alpha_cutoff = 0.0;
        match material.alpha_mode() {
            AlphaMode::Mask if !emits => alpha_cutoff = material.alpha_cutoff().unwrap_or(0.5).max(0.0) / alpha,
            AlphaMode::Blend => self.blended.extend(material.index()),
            _ => {}
        }
        let passes = material.transmission().map_or(0.0, |t| t.transmission_factor().clamp(0.0, 1.0));
        let id = if alpha_cutoff > 1.0 {
            NONE
        } else {
            self.import.add_material(Material {
                albedo: [r, g, b].map(|c| c * (1.0 - passes)),
                emission,
                two_sided: material.double_sided(),
                albedo_texture,
                // 0 / 0: no matter what.
                alpha_cutoff: if albedo_texture == NONE || alpha_cutoff.is_nan() { 0.0 } else { alpha_cutoff },
                transmission: [r, g, b].map(|c| c * passes),
            })?
        };
        self.materials.insert(material.index(), id);
        Ok(id)
    }

    /// The scene's texture for an image, which is read when it is first used.
    fn texture(&mut self, image: usize) -> Result<u32> {
        if let Some(id) = self.images.get(&image) {
            return Ok(*id);
        }
        let read = self.image(image);
        let id = match self.import.image(image, read)? {
            Some(texture) => self.import.add_texture(texture)?,
            None => NONE,
        };
        self.images.insert(image, id);
        Ok(id)
    }

    /// (Read from the JSON: the crate's view of images panics at images without a URI and a buffer view.)
    fn image(&mut self, image: usize) -> Attempt<Texture> {
        let Some(json) = self.document.as_json().images.get(image) else {
            return Ok(Err("there is none of this number".into()));
        };
        if let Some(view) = &json.buffer_view {
            let Some(view) = self.document.views().nth(view.value()) else {
                return Ok(Err("its buffer view is missing".into()));
            };
            let buffer = &self.buffers[view.buffer().index()];
            let bytes = view.offset().checked_add(view.length()).and_then(|end| buffer.get(view.offset()..end));
            return match bytes {
                Some(bytes) => texture::decode(self.import, bytes),
                None => Ok(Err("its buffer view does not fit its buffer".into())),
            };
        }
        let Some(uri) = json.uri.as_deref() else {
            return Ok(Err("it has neither a buffer view nor a uri".into()));
        };
        let bytes = match read_uri(self.import, self.text, uri)? {
            Ok(bytes) => bytes,
            Err(what) => return Ok(Err(what)),
        };
        let texture = texture::decode(self.import, &bytes);
        self.import.account.give_back(bytes.capacity());
        texture
    }
}
