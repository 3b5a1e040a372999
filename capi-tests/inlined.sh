#!/usr/bin/env bash
# Lane code is inlined into the entry points of the kernels (x86-64). A lane method or closure that is called there
# instead has been compiled without the entry point's instruction set: the hits stay right, and the speed is a fraction.
#
#     inlined.sh LIBRARY.a      with its symbols; the calls are read from the relocations
#     inlined.sh --self-test    the check fails where it must
set -euo pipefail

# What entry points may call of this crate. Rare: rays nearly parallel to an axis or from far away, distances in wider precision, buffers
# of a call, rays that leave a stream or must be scaled in an instance. Without lanes: a leaf's one box, and what a filter says of one hit.
allowed='RaySetup::(make_slow|change_for_boxes)|Bundle::accurate|triangle::accurate_distance|single::(take_room|give_room_back)'
allowed+='|stream_rays::(Room::(take|give_back|leave_alone)|sort_rest)|stream::Traversal<T>::leave_alone'
allowed+='|Scene>::meet_one_by_one|CompactLeaf::outer_box|<bakelite::trace::filter::Filter as bakelite::trace::filter::Accept>::accepts'
# Entry points: src/trace/kernels.rs (streams on AVX-512 with and without VBMI2), src/photon/estimate.rs and
# src/direct/light_tree.rs, of each ISA.
entry='bakelite::(trace::kernels|photon::estimate|direct::light_tree)::(portable|avx2|avx512|vbmi2)(_streams)?::'
# Fewer than these were not all found: 17 kernels of rays, one of photons and one of lights, 3 ISAs, and 4 with VBMI2.
least=61

# check: reads a disassembly with relocations.
check() {
    awk -v entry="$entry" -v allowed="$allowed" -v least="$least" '
        # The head of a function: ADDRESS <NAME>:
        /^[0-9a-f]+ <.*>:$/ {
            name = $0
            sub(/^[0-9a-f]+ </, "", name)
            sub(/>:$/, "", name)
            inside = name ~ entry && name !~ /::TABLE/
            if (inside)
                found[name]++
            next
        }
        !inside { next }
        # A call or a jump out of the function to a name, or a relocation with the symbol (it may stand at a load of the
        # address, which is called later).
        /\t(call|jmp)/ {
            target = ""
            if (match($0, /<[^>+]*(<[^>]*>[^>+]*)*>$/))
                target = substr($0, RSTART + 1, RLENGTH - 2)
            if (target != "" && target != name && target !~ /\+0x/)
                judge(target)
            next
        }
        /R_X86_64_(PLT32|PC32|GOTPCREL|GOTPCRELX|REX_GOTPCRELX|CODE_4_GOTPCRELX)/ {
            target = $0
            sub(/.*R_X86_64_[A-Z0-9_]*[ \t]+/, "", target)
            sub(/[-+]0x[0-9a-f]+$/, "", target)
            judge(target)
        }
        function judge(target) {
            calls++
            if ((target ~ /bakelite::|core_arch|(^|<)wide::|glam::/) && target !~ allowed && target !~ /^\.(text|rodata)/) {
                if (target ~ /::[A-Z][A-Z0-9_]*$/)
                    return # a table
                print "   " name " calls " target
                bad++
            }
        }
        END {
            for (name in found)
                count += found[name]
            printf "%d entry points, %d calls, %d of lane code\n", count, calls, bad
            if (count < least) {
                print "   fewer entry points than there are: " least
                exit 1
            }
            exit bad > 0
        }'
}

if [ "$1" = --self-test ]; then
    least=1
    # `set -e` does not look at `! COMMAND`.
    fails() {
        if check; then
            echo 'self-test: THE CHECK DOES NOT FAIL' >&2
            exit 1
        fi
    }
    function_calls() {
        printf '%s\n' "0000000000000000 <bakelite::trace::kernels::avx2::intersect>:" \
            $'   0:\tff 15 00 00 00 00 \tcall   *0x0(%rip)        # 6 <x>' $'\t\t\t2: R_X86_64_GOTPCRELX\t'"$1-0x4" $'   6:\tc3 \tret'
    }
    function_calls 'memset' | check
    function_calls '<bakelite::trace::tree::RaySetup>::make_slow' | sed 's/<bakelite::trace::tree::RaySetup>/bakelite::trace::tree::RaySetup/' | check
    function_calls '<bakelite::simd::avx2::A8 as bakelite::simd::Lanes>::mul_add' | fails
    function_calls 'bakelite::trace::single::many::{{closure}}' | fails
    printf '0000 <bakelite::trace::kernels::avx2::gather>:\n   0:\te8 \tcall   20 <core::core_arch::x86::avx::_mm256_add_ps>\n' | fails
    least=33
    function_calls 'memset' | fails
    echo 'self-test: passed'
    exit 0
fi
objdump -dr --no-show-raw-insn -C "$1" | check
