-- Links of the manual: documents lead to documents, names of the header to its pages, files of the repository nowhere.

local pages, symbols = {}, {}

for name, file in os.getenv("MANUAL_PAGES"):gmatch("(%S+):(%S+)") do
    pages[file] = name .. ".html"
end

local tags = assert(io.open(os.getenv("MANUAL_TAGS"))):read("a")
for compound in tags:gmatch("<compound kind=\"struct\">(.-)</compound>") do
    symbols[compound:match("<name>(.-)</name>")] = compound:match("<filename>(.-)</filename>")
end
for member in tags:gmatch("<member kind=\"[^\"]*\">(.-)</member>") do
    local name, file, anchor = member:match("<name>(.-)</name>.-<anchorfile>(.-)</anchorfile>.-<anchor>(.-)</anchor>")
    if name and (name:match("^bk_") or name:match("^BK_")) then
        symbols[name] = symbols[name] or (file .. "#" .. anchor)
    end
end

-- The path from the root of the repository of what a document names relative to itself.
local function from_root(path)
    local folder = os.getenv("MANUAL_FILE"):match("^(.*/)") or ""
    local full = folder .. path
    repeat
        local before = full
        full = full:gsub("[^/]+/%.%./", "", 1)
    until full == before
    return full
end

local function is_elsewhere(target)
    return target:match("^%a+:") or target:match("^#")
end

function Link(link)
    if is_elsewhere(link.target) then
        return link
    end
    local path, anchor = link.target:match("^([^#]*)(.*)$")
    path = from_root(path)
    if path == "include/bakelite.h" then
        link.target = "header/bakelite_8h.html"
    elseif pages[path] then
        link.target = pages[path] .. anchor
    elseif path:match("^LICENSE") then
        link.target = path
    else
        assert(io.open(path), os.getenv("MANUAL_FILE") .. ": there is no " .. path):close()
        return link.content
    end
    return link
end

function Image(image)
    if not is_elsewhere(image.src) then
        image.src = image.src:match("[^/]+$")
    end
    return image
end

function Code(code)
    local page = symbols[code.text:match("^[%w_]+") or ""]
    if page and (code.text:match("^[%w_]+$") or code.text:match("^[%w_]+%(%)$")) then
        return pandoc.Link(code, "header/" .. page), false
    end
end

-- Top down, and not into what has become a link: code inside of links stays as it is.
return { { Link = Link, Image = Image }, {
    traverse = "topdown",
    Link = function(link) return link, false end,
    Code = Code,
} }
