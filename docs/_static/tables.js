// Tables sort by a click on a header (sortable.min.js); the index of environments can be filtered.
'use strict';

const NUMBER = /^[-+]?\d[\d.]*/;
const FILTERS = ['character', 'terrain', 'actuation'];

const text = (element) => element.textContent.trim();

function makeSortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  const rows = [...table.tBodies[0].rows];
  if (rows.length < 3 || !heads.some(text)) return;
  if (rows.some((row) => !text(row.cells[0]))) return; // a row without a name belongs to the one above
  table.classList.add('sortable', 'n-last');
  heads.forEach((head, column) => {
    if (!text(head)) {
      head.classList.add('no-sort');
      return;
    }
    head.tabIndex = 0;
    head.addEventListener('keydown', (event) => event.key === 'Enter' && head.click());
    const cells = rows.map((row) => row.cells[column]);
    const numbers = cells.map((cell) => text(cell).replace(/^[–]$/, ''));
    if (!numbers.every((number) => !number || NUMBER.test(number))) return;
    cells.forEach((cell, row) => { cell.dataset.sort = (numbers[row].match(NUMBER) || [''])[0]; });
  });
}

function makeFilters(tables) {
  const rows = tables.flatMap((table) => {
    const heads = [...table.tHead.rows[0].cells].map(text);
    const section = table.closest('section');
    const family = text(section.querySelector('h2')).split(':')[0];
    return [...table.tBodies[0].rows].map((row) => {
      const values = Object.fromEntries(heads.map((head, column) => [head, text(row.cells[column])]));
      return { row, section, words: text(row).toLowerCase(), values: { family, ...values } };
    });
  });
  const bar = document.createElement('form');
  bar.className = 'filters';
  const controls = ['family', ...FILTERS].map((name) => {
    const select = document.createElement('select');
    const found = [...new Set(rows.map((each) => each.values[name]))].sort();
    select.add(new Option('all', '*'));
    found.forEach((value) => select.add(new Option(value || 'none', value)));
    return [name, select];
  });
  const search = document.createElement('input');
  search.type = 'search';
  [...controls, ['words', search]].forEach(([name, control]) => {
    const label = document.createElement('label');
    label.append(name, control);
    bar.append(label);
  });
  const count = document.createElement('output');
  bar.append(count);
  const update = () => {
    const words = search.value.toLowerCase().split(/\s+/);
    const shown = rows.filter((each) => {
      const fits = controls.every(([name, { value }]) => value === '*' || each.values[name] === value)
        && words.every((word) => each.words.includes(word));
      each.row.hidden = !fits;
      return fits;
    });
    const sections = new Set(shown.map((each) => each.section));
    rows.forEach(({ section }) => { section.hidden = !sections.has(section); });
    count.textContent = `${shown.length} of ${rows.length}`;
  };
  bar.addEventListener('input', update);
  bar.addEventListener('submit', (event) => event.preventDefault());
  rows[0].section.before(bar);
  update();
}

// Names of ids and modules are longer than a narrow screen is wide: they may break between their parts.
function makeBreakable(element) {
  const walker = document.createTreeWalker(element, NodeFilter.SHOW_TEXT);
  const nodes = [];
  while (walker.nextNode()) nodes.push(walker.currentNode);
  nodes.forEach((node) => {
    const parts = node.data.split(/(?<=\w[_.])(?=\w)|(?<=[a-z])(?=[A-Z])/);
    node.replaceWith(...parts.flatMap((part, i) => (i ? [document.createElement('wbr'), part] : [part])));
  });
}

document.querySelectorAll('article h1, article td :is(a, code), article td:first-child, .sidebar-tree a')
  .forEach(makeBreakable);
const tables = [...document.querySelectorAll('article table')].filter((table) => table.tHead);
tables.forEach(makeSortable);
const index = tables.filter((table) => {
  const heads = [...table.tHead.rows[0].cells].map(text);
  return FILTERS.every((name) => heads.includes(name));
});
if (index.length) makeFilters(index);
