//! Every operation of every ISA that the machine has against plain f32.

use super::*;

const SPECIAL: [f32; 16] = [
    0.0,
    -0.0,
    1.0,
    -1.5,
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    1e-40,
    f32::MIN_POSITIVE,
    f32::MAX,
    -2.0,
    3.25,
    1e18,
    -1e-18,
    7.0,
    0.1,
];

/// Runs `check::<S>` for each ISA that the machine has.
macro_rules! on_every_isa {
    ($check:ident) => {
        for isa in Isa::available() {
            let check: unsafe fn() = match isa {
                Isa::Portable => $check::<Portable>,
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => $check::<Avx2>,
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 => $check::<Avx512>,
                #[cfg(not(target_arch = "x86_64"))]
                _ => unreachable!(),
            };
            // SAFETY: the ISA is available.
            unsafe { check() };
        }
    };
}

fn same(a: f32, b: f32) -> bool {
    a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan())
}

unsafe fn check_lanes<L: Lanes>() {
    let get = |v: L, i: usize| v.to_array()[i];
    let mut rotated = SPECIAL;
    for _ in 0..16 {
        rotated.rotate_left(1);
        for base in (0..16).step_by(L::WIDTH) {
            // SAFETY: base + WIDTH ≤ 16, and the caller vouches for the ISA.
            let (a, b) = unsafe { (L::load(SPECIAL[base..].as_ptr()), L::load(rotated[base..].as_ptr())) };
            for i in 0..L::WIDTH {
                let (x, y) = (SPECIAL[base + i], rotated[base + i]);
                assert!(same(get(a + b, i), x + y), "{x} + {y}");
                assert!(same(get(a - b, i), x - y), "{x} - {y}");
                assert!(same(get(a * b, i), x * y), "{x} * {y}");
                assert!(same(get(a.div(b), i), x / y), "{x} / {y}");
                assert!(same(get(a.sqrt(), i), x.sqrt()), "sqrt({x})");
                let (min, max) = (if x < y { x } else { y }, if x > y { x } else { y });
                assert!(same(get(a.min(b), i), min), "min({x}, {y}) = {}", get(a.min(b), i));
                assert!(same(get(a.max(b), i), max), "max({x}, {y}) = {}", get(a.max(b), i));
                let (fused, plain) = (x.mul_add(y, 0.75), x * y + 0.75);
                // SAFETY: as above.
                let r = get(a.mul_add(b, unsafe { L::splat(0.75) }), i);
                assert!(same(r, fused) || same(r, plain), "{x} * {y} + 0.75 = {r}");
                assert_eq!(a.lt(b).bits() >> i & 1 == 1, x < y);
                assert_eq!(a.le(b).bits() >> i & 1 == 1, x <= y);
                assert_eq!(a.lt(b).or(b.lt(a)).bits() >> i & 1 == 1, x < y || y < x);
                assert_eq!(a.le(b).and(b.le(a)).bits() >> i & 1 == 1, x == y);
                assert!(same(get(L::select(a.lt(b), a, b), i), min));
            }
            assert_eq!(a.le(a).any(), SPECIAL[base..base + L::WIDTH].iter().any(|x| !x.is_nan()));
        }
    }
}

unsafe fn check_compress<L: Compress>(orders: [[u32; 8]; 2]) {
    let names: [u32; 8] = std::array::from_fn(|i| 100 + i as u32);
    let values: [f32; 8] = std::array::from_fn(|i| i as f32);
    // Two orders in one word, at different shifts.
    let order: [u32; 8] = std::array::from_fn(|i| orders[0][i] | orders[1][i] << 21);
    for set in 0..1u32 << L::WIDTH {
        let chosen: [f32; 8] = std::array::from_fn(|i| (set >> i & 1) as f32);
        for (k, shift) in [0, 21].into_iter().enumerate() {
            let (mut out, mut out_names) = ([0.0; 8], [0; 8]);
            // SAFETY: arrays of eight, and the caller vouches for the ISA.
            let places = unsafe {
                let mask = L::splat(0.5).lt(L::load(chosen.as_ptr()));
                let v = L::load(values.as_ptr());
                v.compress(names.as_ptr(), order.as_ptr(), shift, mask, out.as_mut_ptr(), out_names.as_mut_ptr())
            };
            let expected: Vec<u32> =
                orders[k][..L::WIDTH].iter().copied().filter(|&lane| set >> lane & 1 == 1).collect();
            let taken = (0..L::WIDTH).filter(|&i| set >> orders[k][i] & 1 == 1);
            assert_eq!(places, taken.map(|i| 1u32 << i).sum::<u32>());
            for (i, lane) in expected.into_iter().enumerate() {
                assert_eq!((out[i], out_names[i]), (lane as f32, 100 + lane));
            }
        }
    }
}

unsafe fn check_gather<F: Four>() {
    let values = SPECIAL;
    for from in [[0, 1, 2, 3], [15, 4, 4, 9], [7, 7, 7, 7]] {
        // SAFETY: pointers into `values`, and the caller vouches for the ISA.
        let lanes = unsafe { F::gather(from.map(|i| &raw const values[i])) }.to_array();
        assert!((0..4).all(|i| same(lanes[i], SPECIAL[from[i]])));
    }
}

unsafe fn check_bytes<E: Eight>() {
    for first in 0..=248u8 {
        let bytes: [u8; 8] = std::array::from_fn(|i| first + i as u8);
        let numbers: [u32; 8] = std::array::from_fn(|i| ((first >> i) as u32) << 31 | 0x4123_4567);
        // SAFETY: arrays of eight, and the caller vouches for the ISA.
        let (lanes, bits) = unsafe { (E::from_bytes(bytes.as_ptr()).to_array(), E::highest_bits(numbers.as_ptr())) };
        assert!((0..8).all(|i| lanes[i] == bytes[i] as f32));
        assert_eq!(bits, first as u32);
    }
}

unsafe fn check_halves<E: Eight>() {
    let p = SPECIAL.as_ptr();
    // SAFETY: `SPECIAL` has 16 floats, and the caller vouches for the ISA.
    let (pair, v) = unsafe { (E::pair(p.add(5), p.add(1)).to_array(), E::load(p.add(4))) };
    assert!((0..4).all(|i| same(pair[i], SPECIAL[5 + i]) && same(pair[4 + i], SPECIAL[1 + i])));
    let spread = [v.spread::<0>(), v.spread::<1>(), v.spread::<2>(), v.spread::<3>()].map(|v| v.to_array());
    for (k, spread) in spread.iter().enumerate() {
        assert!((0..8).all(|i| same(spread[i], SPECIAL[4 + i / 4 * 4 + k])));
    }
    // SAFETY: as above.
    let rows = std::array::from_fn(|i| unsafe { E::load(p.add(i)) });
    for (j, column) in E::transpose(rows).into_iter().enumerate() {
        assert!((0..8).all(|i| same(column.to_array()[i], SPECIAL[i + j])));
    }
}

unsafe fn check_pick<S: Simd>() {
    for count in (0..70).chain([255, 256, 1000]) {
        // Beyond `count` masks are 0, whereas numbers may be anything.
        let masks: Vec<u8> = (0..count + 32).map(|i| if i < count { (i * i * 37 + i / 3) as u8 } else { 0 }).collect();
        for bit in 0..8 {
            let mut numbers: Vec<u16> = (0..2 * count + 32).map(|i| 60_000 + i as u16).collect();
            let chosen = (0..count).filter(|&i| masks[i] >> bit & 1 == 1);
            let expected: Vec<u16> = chosen.map(|i| 60_000 + i as u16).collect();
            // SAFETY: there are 32 masks and numbers more than `count`, and the caller vouches for the ISA.
            let n = unsafe {
                let numbers = numbers.as_mut_ptr();
                S::pick(masks.as_ptr(), numbers, count, bit, numbers.add(count))
            };
            assert_eq!(numbers[count..count + n], expected);
        }
    }
}

unsafe fn check_simd<S: Simd>() {
    // SAFETY: the caller vouches for the ISA; `SPECIAL` has 16 floats.
    unsafe {
        check_gather::<S::F4>();
        check_bytes::<S::F8>();
        check_lanes::<S::F4>();
        check_lanes::<S::F8>();
        check_lanes::<S::Packet>();
        check_compress::<S::F4>([[0, 1, 2, 3, 0, 0, 0, 0], [2, 0, 3, 1, 0, 0, 0, 0]]);
        check_compress::<S::F8>([[0, 1, 2, 3, 4, 5, 6, 7], [6, 2, 7, 0, 5, 1, 3, 4]]);
        check_halves::<S::F8>();
        check_pick::<S>();
    }
}

#[test]
fn lanes_agree_with_scalars_on_every_isa() {
    on_every_isa!(check_simd);
    #[cfg(target_arch = "x86_64")]
    if Isa::has_vbmi2() {
        // SAFETY: the machine has it.
        unsafe { check_simd::<Avx512Vbmi2>() };
    }
}
