// The data of the report, from its page.

export const DATA = JSON.parse(document.getElementById("data").textContent);
