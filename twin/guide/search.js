// Search of the guide: sections in which every word occurs, those with it in their title first.
"use strict";
{
  const field = document.getElementById("search"), list = document.getElementById("found");
  const MAX_RESULTS = 20, SNIPPET = 90;

  const find = (words) => sections
    .map((section) => ({ section, title: `${section[1]} ${section[2]}`.toLowerCase(), text: section[3].toLowerCase() }))
    .filter(({ title, text }) => words.every((word) => title.includes(word) || text.includes(word)))
    .map((hit) => ({ ...hit, rank: words.filter((word) => hit.title.includes(word)).length }))
    .sort((a, b) => b.rank - a.rank)
    .slice(0, MAX_RESULTS);

  const draw = ({ section: [href, page, heading, body], text }, words) => {
    const link = document.createElement("a"), snippet = document.createElement("small");
    const at = Math.max(0, text.indexOf(words[0]) - 20), begin = body.lastIndexOf(" ", at) + 1;
    link.href = href;
    link.textContent = heading && heading !== page ? `${page}: ${heading}` : page;
    snippet.textContent = body.slice(begin, begin + SNIPPET);
    link.append(snippet);
    return link;
  };

  field.addEventListener("input", () => {
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    const hits = words.length ? find(words) : [];
    list.replaceChildren(...hits.map((hit) => draw(hit, words)));
    if (words.length && !hits.length) list.textContent = "nothing found";
  });
  field.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && list.firstElementChild) location.href = list.firstElementChild.href;
  });
}
