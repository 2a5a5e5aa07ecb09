// What the report says of the run, from its page.

export const DATA = JSON.parse(document.getElementById("data").textContent);
