//! Textures: albedo and alpha, addressed by the meshes' first texture coordinates.
//!
//! A look-up returns what a shader shows of the full image: the image repeats, and values are interpolated between the
//! centres of four texels (colours in linear light). Nothing is stored beside the image; callers that need the colour
//! of an area average look-ups.

use crate::base::error::{Result, invalid_argument};
use glam::{Vec2, Vec3};
use std::sync::LazyLock;

/// Maximum number of texels of a texture along each axis.
pub const MAX_TEXTURE_SIZE: u32 = 1 << 14;

/// An image of 8-bit sRGB colours and linear alpha. Row 0 lies at v = 0, column 0 at u = 0, as in glTF;
/// u and v repeat beyond [0, 1].
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// Number of texels along u, 1 to [`MAX_TEXTURE_SIZE`].
    pub width: u32,
    /// Number of texels along v, 1 to [`MAX_TEXTURE_SIZE`].
    pub height: u32,
    /// Texels, row by row.
    pub rgba8: Vec<[u8; 4]>,
}

/// Linear light of an 8-bit sRGB value (IEC 61966-2-1).
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let c = i as f64 / 255.0;
        (if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }) as f32
    })
});

/// The four texels around a point, with its position between them.
struct Around {
    texels: [[u8; 4]; 4],
    x: f32,
    y: f32,
}

impl Around {
    /// Interpolates so that four equal values give just that value.
    #[inline]
    fn mix(&self, value: impl Fn(&[u8; 4]) -> f32) -> f32 {
        let [a, b, c, d] = [0, 1, 2, 3].map(|i| value(&self.texels[i]));
        let (top, bottom) = (a + (b - a) * self.x, c + (d - c) * self.x);
        top + (bottom - top) * self.y
    }
}

impl Texture {
    /// Checks width, height and the number of texels.
    pub fn validate(&self) -> Result<()> {
        for (name, size) in [("width", self.width), ("height", self.height)] {
            if !(1..=MAX_TEXTURE_SIZE).contains(&size) {
                return invalid_argument!("the texture's {name} is {size}, outside 1 to {MAX_TEXTURE_SIZE}");
            }
        }
        let texels = self.width as usize * self.height as usize;
        if self.rgba8.len() != texels {
            return invalid_argument!("rgba8 has {} texels, not width × height = {texels}", self.rgba8.len());
        }
        Ok(())
    }

    /// Size of the texels in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.rgba8[..])
    }

    /// Number of texels along u and v.
    pub(crate) fn size(&self) -> Vec2 {
        Vec2::new(self.width as f32, self.height as f32)
    }

    /// Minimum alpha of all texels: no look-up returns less.
    pub(crate) fn least_alpha(&self) -> f32 {
        self.rgba8.iter().map(|t| t[3]).min().map_or(1.0, |a| a as f32 / 255.0)
    }

    /// Colour in linear light.
    #[inline]
    pub fn color(&self, uv: Vec2) -> Vec3 {
        let (around, linear) = (self.around(uv), &*LINEAR);
        Vec3::from_array([0, 1, 2].map(|c| around.mix(|t| linear[t[c] as usize])))
    }

    /// Alpha, in [0, 1].
    #[inline]
    pub fn alpha(&self, uv: Vec2) -> f32 {
        self.around(uv).mix(|t| t[3] as f32 / 255.0)
    }

    #[inline]
    fn around(&self, uv: Vec2) -> Around {
        // The texels beside a point along an axis, and its distance from the first towards the second. (Coordinates
        // that are not finite become 0.)
        let along = |x: f32, size: u32| {
            let at = (x - x.floor()) * size as f32 - 0.5;
            let below = at.floor();
            let first = if below < 0.0 { size - 1 } else { (below as u32).min(size - 1) };
            let part = if at.is_finite() { at - below } else { 0.0 };
            (first as usize, if first + 1 == size { 0 } else { first as usize + 1 }, part)
        };
        let (x0, x1, x) = along(uv.x, self.width);
        let (y0, y1, y) = along(uv.y, self.height);
        let texel = |x: usize, y: usize| self.rgba8[y * self.width as usize + x];
        Around { texels: [texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1)], x, y }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(width: u32, height: u32, rgba8: &[[u8; 4]]) -> Texture {
        Texture { width, height, rgba8: rgba8.to_vec() }
    }

    #[test]
    fn sizes_are_checked() {
        assert!(texture(2, 1, &[[0; 4]; 2]).validate().is_ok());
        for (t, culprit) in [
            (texture(0, 1, &[]), "width is 0"),
            (texture(1, 0, &[]), "height is 0"),
            (texture(MAX_TEXTURE_SIZE + 1, 1, &[]), "width is 16385"),
            (texture(2, 2, &[[0; 4]; 3]), "rgba8 has 3 texels"),
        ] {
            let e = t.validate().unwrap_err().to_string();
            assert!(e.contains(culprit), "{e}");
        }
    }

    #[test]
    fn colors_are_srgb_and_interpolated_in_linear_light() {
        let t = texture(2, 1, &[[0, 255, 128, 0], [255, 255, 128, 255]]);
        // Texel centres.
        assert_eq!(t.color(Vec2::new(0.25, 0.5)).x, 0.0);
        assert_eq!(t.color(Vec2::new(0.75, 0.5)).x, 1.0);
        // ((128/255 + 0.055) / 1.055)^2.4.
        assert!((t.color(Vec2::new(0.25, 0.5)).z - 0.215_861).abs() < 1e-5);
        // Half-way between, on both sides of the border where the image repeats.
        for u in [0.5, 0.0, 1.0, -3.0, 7.5] {
            let c = t.color(Vec2::new(u, 0.3));
            assert!((c.x - 0.5).abs() < 1e-6 && c.y == 1.0, "{u}: {c}");
            assert!((t.alpha(Vec2::new(u, -0.3)) - 0.5).abs() < 1e-6);
        }
        assert!((t.alpha(Vec2::new(0.25 + 0.125, 0.0)) - 0.25).abs() < 1e-6);
    }

    #[test]
    fn rows_go_up_with_v() {
        let t = texture(1, 4, &[[0, 0, 0, 10], [0, 0, 0, 20], [0, 0, 0, 30], [0, 0, 0, 40]]);
        for row in 0..4 {
            let alpha = t.alpha(Vec2::new(0.9, (row as f32 + 0.5) / 4.0 - 2.0));
            assert_eq!(alpha, 10.0 * (row + 1) as f32 / 255.0);
        }
        assert_eq!(t.least_alpha(), 10.0 / 255.0);
    }

    #[test]
    fn equal_texels_give_exactly_their_value_everywhere() {
        let t = texture(3, 3, &[[200, 7, 99, 255]; 9]);
        for i in 0..1000 {
            let uv = Vec2::new(i as f32 * 0.37, i as f32 * -0.113);
            assert_eq!((t.alpha(uv), t.color(uv)), (1.0, t.color(Vec2::ZERO)));
        }
    }

    #[test]
    fn coordinates_that_are_not_finite_or_huge_are_harmless() {
        let t = texture(2, 2, &[[1, 2, 3, 4]; 4]);
        for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -f32::MAX, -1e-30, 1.0 - f32::EPSILON] {
            assert_eq!(t.alpha(Vec2::new(x, x)), 4.0 / 255.0, "{x}");
        }
    }
}
