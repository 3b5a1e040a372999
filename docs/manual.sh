#!/usr/bin/env bash
# Builds the manual: README.md, docs/ and what belongs to them by pandoc, include/bakelite.h by Doxygen. Names of
# the header that the documents mention lead to its pages.
#
#     docs/manual.sh [FOLDER]        default: target/manual; start with index.html
#     man -M FOLDER/man bk_bake      each function, structure and constant has a man page
#
# Fails if a document or a man page leads to what is not there, or if Doxygen warns.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-target/manual}
for tool in doxygen pandoc; do
    command -v $tool >/dev/null || {
        echo "There is no $tool: apt-get install doxygen pandoc" >&2
        exit 1
    }
done
rm -rf "$out"
mkdir -p "$out"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# ---- The header ----

{
    cat docs/Doxyfile
    echo "OUTPUT_DIRECTORY = $out"
    echo "HTML_OUTPUT = header"
    echo "GENERATE_TAGFILE = $work/header.tag"
    echo "GENERATE_MAN = YES"
    echo "MAN_LINKS = YES"
} | doxygen -

# Doxygen names the page of a section as the header does ("device"), and makes one for every field ("width"). Sections are
# renamed so that they cannot hide pages of other libraries, and fields are found on the pages of their structures.
cd "$out/man/man3"
sections=$(sed -n 's/^ \* @defgroup \([a-z]*\) .*/\1/p' "$OLDPWD/include/bakelite.h")
for section in $sections; do
    mv "$section.3" "bakelite-$section.3"
    sed -i "1s/^.TH \"$section\"/.TH \"bakelite-$section\"/; s/^$section \\\\-/bakelite-$section \\\\-/" "bakelite-$section.3"
done
sed -i -E 's|^\.so man3/([a-z]+\.3)$|.so man3/bakelite-\1|' bk_*.3 BK_*.3
find . -name '*.3' ! -name 'bk_*' ! -name 'BK_*' ! -name 'bakelite*' -delete
sed -n 's|^\.so man3/||p' ./*.3 | sort -u | while read -r page; do
    [ -e "$page" ] || { echo "man pages lead to $page, which is not there" >&2 && exit 1; }
done
cd "$OLDPWD"

# ---- The documents ----

pages='index:README.md guide:docs/guide.md install:docs/install.md performance:docs/performance.md accuracy:docs/accuracy.md
    architecture:docs/architecture.md robustness:docs/robustness.md experiments:docs/experiments.md scene_file:docs/scene_file.md
    contributing:CONTRIBUTING.md security:SECURITY.md changelog:CHANGELOG.md'
{
    echo '<nav>'
    for page in $pages; do
        name=${page%%:*}
        echo "<a href=\"$name.html\">${name/index/start}</a>"
        [ "$name" != guide ] || echo '<a href="header/topics.html">header</a>'
    done
    echo '</nav>'
} >"$work/nav.html"
# Doxygen renamed the list of groups.
[ -e "$out/header/topics.html" ] || sed -i 's|header/topics.html|header/modules.html|' "$work/nav.html"

for page in $pages; do
    name=${page%%:*}
    file=${page#*:}
    MANUAL_PAGES=$pages MANUAL_TAGS=$work/header.tag MANUAL_FILE=$file pandoc --from gfm --to html5 --standalone \
        --metadata "title=Bakelite: $(sed -n '1s/^# //p' "$file")" --lua-filter docs/manual/links.lua \
        --css manual.css --include-before-body "$work/nav.html" --output "$out/$name.html" "$file"
done
cp docs/manual/manual.css "$out"
cp benches/pictures/atrium.jpg LICENSE-APACHE LICENSE-MIT "$out"
echo "$out/index.html"
